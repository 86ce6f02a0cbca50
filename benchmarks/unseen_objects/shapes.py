"""Solids as signed distances on a grid: thin legs, links, walls around a hollow, sheets, holes, parts."""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import pairwise

import numpy as np

Field = np.ndarray
"""(N, N, N) distances, negative inside; or coordinates."""

Point = Sequence[float] | np.ndarray


class Grid:
    """The places of an N x N x N grid over the cube from -1.1 to 1.1, and solids on it."""

    def __init__(self, count: int) -> None:
        self.axis = np.linspace(-1.1, 1.1, count)
        self.x, self.y, self.z = np.meshgrid(self.axis, self.axis, self.axis, indexing="ij")

    @property
    def around(self) -> Field:
        """Distance from the z axis."""
        return np.hypot(self.x, self.y)

    def pillar(self, x: float, y: float) -> Field:
        """Distance from a line along the z axis."""
        return np.hypot(self.x - x, self.y - y)

    def ball(self, center: Point, radius: float) -> Field:
        """Round."""
        return np.sqrt(sum(place**2 for place in self._from(center))) - radius

    def rod(self, a: Point, b: Point, radius: float) -> Field:
        """With round ends."""
        way = np.subtract(b, a)
        places = self._from(a)
        along = np.clip(sum(p * w for p, w in zip(places, way, strict=True)) / (way @ way), 0, 1)
        return np.sqrt(sum((p - along * w) ** 2 for p, w in zip(places, way, strict=True))) - radius

    def block(self, center: Point, half: Point, rounding: float = 0.02) -> Field:
        """Along the axes."""
        over = [np.abs(place) - size + rounding for place, size in zip(self._from(center), half, strict=True)]
        outside = np.sqrt(sum(np.maximum(value, 0) ** 2 for value in over))
        return outside + np.minimum(np.maximum.reduce(over), 0) - rounding

    def ring(self, center: Point, radius: float, thickness: float, axis: int = 2) -> Field:
        """About an axis."""
        places = self._from(center)
        height = places.pop(axis)
        return np.hypot(np.hypot(*places) - radius, height) - thickness

    def disc(self, height: float, radius: float, half: float) -> Field:
        """About the z axis."""
        return np.maximum(self.around - radius, np.abs(self.z - height) - half)

    def ellipsoid(self, center: Point, axes: np.ndarray, radii: Point) -> Field:
        """Its axes are rows; distances are about right near the surface."""
        places = np.stack(self._from(center), axis=-1) @ axes.T
        return (np.sqrt(((places / np.asarray(radii)) ** 2).sum(axis=-1)) - 1) * min(radii)

    def _from(self, center: Point) -> list[Field]:
        return [place - value for place, value in zip((self.x, self.y, self.z), center, strict=True)]


def union(*solids: Field) -> Field:
    return reduce(np.minimum, solids)


def chair(g: Grid) -> Field:
    """Six holes: four between the slats of its back, two below."""
    sides = (-1, 1)
    legs = [g.rod((0.37 * i, 0.37 * j, 0), (0.42 * i, 0.42 * j, -0.8), 0.04) for i in sides for j in sides]
    posts = [g.rod((0.38 * i, 0.38, 0), (0.4 * i, 0.48, 0.8), 0.04) for i in sides]
    slats = [g.rod((x, 0.39, 0), (x, 0.48, 0.78), 0.025) for x in (-0.2, 0, 0.2)]
    bars = [g.rod((-0.4, 0.4 * j, -0.45), (0.4, 0.4 * j, -0.45), 0.025) for j in sides]
    top = g.rod((-0.4, 0.48, 0.78), (0.4, 0.48, 0.78), 0.045)
    return union(g.block((0, 0, 0), (0.42, 0.42, 0.04)), top, *legs, *posts, *slats, *bars)


def chain(g: Grid) -> Field:
    """Three parts that hang in each other, with a hole each."""
    return union(*(g.ring((0.44 * i, 0, 0), 0.32, 0.08, 1 if i == 0 else 2) for i in (-1, 0, 1)))


def bowl(g: Grid) -> Field:
    """A thin wall, and a handle over the opening."""
    wall = np.maximum(np.abs(g.ball((0, 0, 0.1), 0.8)) - 0.035, g.z - 0.15)
    handle = np.maximum(g.ring((0, 0, 0.1), 0.8, 0.045, 1), 0.1 - g.z)
    return union(wall, handle, g.disc(-0.72, 0.3, 0.06))


def vase(g: Grid) -> Field:
    """A hollow that widens behind its opening."""
    radius = 0.32 + 0.16 * np.sin(3.2 * (g.z + 0.3)) + 0.05 * g.z
    wall = np.maximum(0.8 * np.abs(g.around - radius) - 0.035, np.abs(g.z) - 0.9)
    return union(wall, g.disc(-0.87, 0.36, 0.05))


def plant(g: Grid) -> Field:
    """A pot, thin stems, leaves like sheets."""
    rng, up = np.random.default_rng(3), np.array([0, 0, 1.0])
    parts = [np.maximum(g.around - (0.32 + 0.12 * (g.z + 0.6)), np.abs(g.z + 0.65) - 0.3)]
    for angle in 2 * math.pi * np.arange(7) / 7 + 0.2 * rng.random(7):
        out = np.array([math.cos(angle), math.sin(angle), 0])
        tip = (0.5 + 0.35 * rng.random()) * out + (0.1 + 0.75 * rng.random()) * up
        parts.append(g.rod(0.05 * out - 0.4 * up, 0.75 * tip - 0.05 * up, 0.022))
        normal = np.cross(np.cross(up, out), tip + 0.2 * up)
        normal, along = normal / np.linalg.norm(normal), tip / np.linalg.norm(tip)
        parts.append(g.ellipsoid(0.85 * tip, np.stack([along, np.cross(normal, along), normal]), (0.26, 0.13, 0.028)))
    return union(*parts)


def gear(g: Grid) -> Field:
    """Teeth, and six holes through a disc."""
    teeth = 0.78 + 0.1 * np.tanh(4 * np.sin(12 * np.arctan2(g.y, g.x)))
    solid = np.maximum(np.maximum(g.around - teeth, np.abs(g.z) - 0.16), 0.2 - g.around)
    for angle in 2 * math.pi * np.arange(5) / 5:
        hole = np.hypot(g.x - 0.48 * math.cos(angle), g.y - 0.48 * math.sin(angle)) - 0.14
        solid = np.maximum(solid, -hole)
    return solid


def cage(g: Grid) -> Field:
    """The edges of a cube around a ball."""
    e, sides = 0.62, [(i, j) for i in (-1, 1) for j in (-1, 1)]
    bars = [
        g.rod(np.roll((-e, i * e, j * e), turn), np.roll((e, i * e, j * e), turn), 0.05)
        for turn in range(3)
        for i, j in sides
    ]
    return union(g.ball((0, 0, 0), 0.3), *bars)


def plate(g: Grid) -> Field:
    """A bent sheet."""
    return np.maximum(np.abs(g.z - 0.25 * g.around**2) - 0.02, g.around - 0.9)


def figures(g: Grid) -> Field:
    """Three parts side by side, with thin limbs."""
    parts = []
    for x, h in ((-0.6, 0.0), (0.0, 0.1), (0.6, 0.2)):
        parts += [g.rod((x, 0, -0.6), (x, 0, h), 0.13), g.ball((x, 0, 0.25 + h), 0.15)]
        parts += [g.rod((x - 0.2, 0, -0.25), (x + 0.2, 0, -0.05), 0.05)]
        parts += [g.rod((x + 0.09 * i, 0, -0.6), (x + 0.11 * i, 0, -0.9), 0.06) for i in (-1, 1)]
    return union(*parts)


def teapot(g: Grid) -> Field:
    """A closed body with a handle, a spout and a knob."""
    body = g.ellipsoid((0, 0, 0), np.eye(3), (0.52, 0.52, 0.42))
    handle = g.ring((-0.58, 0, 0.02), 0.24, 0.05, 1)
    spout = union(g.rod((0.35, 0, -0.15), (0.68, 0, 0.02), 0.1), g.rod((0.68, 0, 0.02), (0.86, 0, 0.32), 0.06))
    return union(body, handle, spout, g.ball((0, 0, 0.48), 0.08), g.disc(-0.42, 0.28, 0.04))


def comb(g: Grid) -> Field:
    """Fourteen teeth with gaps as narrow as they are."""
    teeth = [g.block((x, 0, -0.1), (0.032, 0.05, 0.4), 0.01) for x in np.linspace(-0.84, 0.84, 14)]
    return union(g.block((0, 0, 0.4), (0.9, 0.07, 0.14)), *teeth)


def clasp(g: Grid) -> Field:
    """A ring on a stand, with a slit so narrow that few photos see light through it."""
    ring = np.maximum(g.ring((0, 0, 0.3), 0.45, 0.13, 1), -g.block((0, 0, 0.8), (0.025, 0.3, 0.3), 0.0))
    return union(ring, g.rod((0, 0, -0.1), (0, 0, -0.7), 0.09), g.disc(-0.75, 0.5, 0.06))


def basket(g: Grid) -> Field:
    """An open cup whose wall has two rows of windows."""
    wall = np.maximum(np.abs(g.around - 0.6) - 0.045, np.abs(g.z) - 0.6)
    for row, z in enumerate((-0.2, 0.25)):
        for angle in 2 * math.pi * (np.arange(8) + 0.5 * row) / 8:
            hole = np.hypot(g.y * math.cos(angle) - g.x * math.sin(angle), g.z - z) - 0.13
            outwards = g.x * math.cos(angle) + g.y * math.sin(angle)
            wall = np.maximum(wall, -np.maximum(hole, -outwards))
    return union(wall, g.disc(-0.6, 0.64, 0.05))


def shelf(g: Grid) -> Field:
    """Six deep compartments before a back wall."""
    case = g.block((0, 0, 0), (0.62, 0.32, 0.72))
    for x in (-0.3, 0.3):
        for z in (-0.45, 0.0, 0.45):
            case = np.maximum(case, -g.block((x, -0.1, z), (0.26, 0.36, 0.19)))
    return case


def cottage(g: Grid) -> Field:
    """Flat sides: walls with recessed windows behind bars, a roof that stands over them, a chimney with a flue."""
    slope = 0.6 * np.abs(g.y) + 0.8 * g.z
    attic = np.maximum(np.maximum(slope - 0.42, np.abs(g.x) - 0.58), -0.1 - g.z)
    roof = np.maximum(np.maximum(np.abs(slope - 0.45) - 0.04, np.abs(g.x) - 0.68), np.abs(g.y) - 0.56)
    solid = union(g.block((0, 0, -0.3), (0.58, 0.44, 0.42), 0), attic, g.block((0, 0, -0.72), (0.62, 0.48, 0.06), 0))
    for x in (-0.3, 0.3):
        for side in (-1, 1):
            pane = np.maximum(g.block((x, 0.44 * side, -0.2), (0.15, 0.06, 0.13), 0), -np.abs(g.x - x) + 0.02)
            solid = np.maximum(solid, -np.maximum(pane, -np.abs(g.z + 0.2) + 0.02))
    solid = np.maximum(solid, -g.block((0.58, 0, -0.4), (0.05, 0.12, 0.26), 0))
    flue = g.block((-0.4, 0.12, 0.9), (0.045, 0.045, 0.2), 0)
    return union(solid, roof, np.maximum(g.block((-0.4, 0.12, 0.6), (0.09, 0.09, 0.26), 0), -flue))


def tree(g: Grid) -> Field:
    """A trunk with roots, whose limbs fork three times and end in tips of a fiftieth."""
    rng, parts = np.random.default_rng(5), []

    def limb(a: np.ndarray, way: np.ndarray, length: float, radius: float, forks: int) -> None:
        b = a + length * way
        parts.append(g.rod(a, b, radius))
        turn = math.tau * rng.random()
        sides = np.linalg.qr(np.column_stack([way, rng.normal(size=(3, 2))]))[0][:, 1:]
        for number in range(3 if forks == 3 else 2 * (forks > 0)):
            angle = turn + math.tau * number / (3 if forks == 3 else 2)
            out = way + 0.75 * sides @ np.array([math.cos(angle), math.sin(angle)]) + np.array([0, 0, 0.15])
            limb(b, out / np.linalg.norm(out), 0.72 * length, 0.62 * radius, forks - 1)

    limb(np.array([0, 0, -0.75]), np.array([0, 0, 1.0]), 0.55, 0.12, 3)
    for angle in math.tau * np.arange(6) / 6:
        tip = np.array([0.4 * math.cos(angle), 0.4 * math.sin(angle), -0.8])
        parts.append(g.rod((0, 0, -0.6), tip, 0.05))
    return union(*parts)


def violin(g: Grid) -> Field:
    """A flat body with a waist, a board that floats over it, a thin neck, a bridge, pegs."""
    lobes = union(g.pillar(0.3, 0) - 0.27, g.pillar(-0.18, 0) - 0.21, g.block((0.06, 0, 0), (0.25, 0.16, 2), 0))
    board = g.block((-0.42, 0, 0.12), (0.36, 0.045, 0.015))
    neck = union(g.rod((-0.3, 0, 0.05), (-0.8, 0, 0.09), 0.035), g.ball((-0.86, 0, 0.05), 0.07))
    pegs = [g.rod((x, -0.13, 0.07), (x, 0.13, 0.07), 0.018) for x in (-0.8, -0.72)]
    tail = union(g.block((0.42, 0, 0.11), (0.12, 0.04, 0.015)), g.rod((0.56, 0, 0), (0.53, 0, 0.11), 0.02))
    return union(
        np.maximum(lobes, np.abs(g.z) - 0.06), board, neck, *pegs, tail, g.block((0.17, 0, 0.1), (0.012, 0.09, 0.06))
    )


def well(g: Grid) -> Field:
    """A round wall around a shaft, two posts, a roof over it, a bar from which a bucket hangs."""
    wall = np.maximum(np.maximum(np.abs(g.around - 0.36) - 0.06, -0.8 - g.z), g.z + 0.3)
    roof = np.maximum(
        np.maximum(np.abs(0.5 * np.abs(g.y) + 0.87 * g.z - 0.7) - 0.03, np.abs(g.x) - 0.55), np.abs(g.y) - 0.42
    )
    posts = [g.block((0.4 * side, 0, 0.05), (0.045, 0.045, 0.75), 0) for side in (-1, 1)]
    bar = union(g.rod((-0.4, 0, 0.15), (0.55, 0, 0.15), 0.03), g.rod((0.55, 0, 0.15), (0.55, 0, 0.0), 0.025))
    bucket = np.maximum(np.maximum(np.abs(np.hypot(g.x, g.y) - 0.11) - 0.025, np.abs(g.z + 0.2) - 0.1), -0.3 - g.z)
    bail = union(g.rod((0, 0, 0.15), (0, 0, -0.1), 0.015), g.rod((-0.12, 0, -0.12), (0.12, 0, -0.12), 0.02))
    return union(wall, g.disc(-0.8, 0.6, 0.05), roof, *posts, bar, bucket, bail, g.disc(-0.29, 0.12, 0.03))


def bucket(g: Grid) -> Field:
    """A wall that widens, open above, and a bail that stands upright."""
    wall = np.maximum(0.95 * np.abs(g.around - (0.45 + 0.15 * g.z)) - 0.03, np.abs(g.z + 0.25) - 0.5)
    bail = np.maximum(g.ring((0, 0, 0.15), 0.52, 0.025, 1), 0.15 - g.z)
    return union(wall, g.disc(-0.75, 0.36, 0.04), bail)


def glasses(g: Grid) -> Field:
    """Two rims, a bridge, and temples that bend down at their ends: nothing is thicker than a twentieth."""
    parts = [g.rod((-0.09, 0, 0.05), (0.09, 0, 0.05), 0.025)]
    for side in (-1, 1):
        hinge, ear = (0.75 * side, 0, 0.08), (0.72 * side, 0.95, 0.08)
        parts += [g.ring((0.4 * side, 0, 0), 0.32, 0.035, 1), g.rod((0.68 * side, 0, 0.08), hinge, 0.03)]
        parts += [g.rod(hinge, ear, 0.024), g.rod(ear, (0.7 * side, 1.05, -0.15), 0.024)]
    return union(*parts)


def lantern(g: Grid) -> Field:
    """Six posts between a base and a roof, a candle among them, and a ring on top: six holes."""
    angles = math.tau * np.arange(6) / 6
    posts = [
        g.rod((0.45 * x, 0.45 * y, -0.65), (0.45 * x, 0.45 * y, 0.45), 0.035)
        for x, y in zip(np.cos(angles), np.sin(angles), strict=True)
    ]
    roof = np.maximum(0.8 * (g.around - 0.55 + 1.3 * (g.z - 0.45)), 0.42 - g.z)
    candle = g.rod((0, 0, -0.6), (0, 0, -0.15), 0.13)
    return union(g.disc(-0.68, 0.55, 0.06), roof, candle, g.ring((0, 0, 0.94), 0.12, 0.03, 1), *posts)


def pretzel(g: Grid) -> Field:
    """A rope whose ends cross above each other and run back into it: three holes."""
    x = (0, 0.4, 0.7, 0.82, 0.7, 0.4, 0.12, -0.15, -0.33, -0.42)
    z = (-0.56, -0.6, -0.38, 0.02, 0.4, 0.52, 0.3, -0.05, -0.32, -0.56)
    y = (0, 0, 0, 0, 0, 0.06, 0.09, 0.09, 0.04, 0)
    halves = [[np.array((side * a, side * b, c)) for a, b, c in zip(x, y, z, strict=True)] for side in (-1, 1)]
    return union(*(g.rod(a, b, 0.1) for path in halves for a, b in pairwise(path)))


def book(g: Grid) -> Field:
    """Open, upright: two covers at an angle, with three leaves between that touch at the spine alone."""
    cover, leaf = (0.8, 0.03), (0.72, 0.018)  # how long, and half how thick
    pages = []
    for angle, (length, half) in ((20, cover), (58, leaf), (90, leaf), (122, leaf), (160, cover)):
        x, y = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        along, across = x * g.x + y * (g.y + 0.4), x * (g.y + 0.4) - y * g.x
        side = np.maximum(np.abs(across) - half, np.abs(along - length / 2) - length / 2)
        pages.append(np.maximum(side, np.abs(g.z) - length * 0.8))
    return union(*pages)


def can(g: Grid) -> Field:
    """For watering: half open above, a long spout that ends in a ball, a handle behind, another over the top."""
    wall = np.maximum(np.abs(g.around - 0.4) - 0.03, np.abs(g.z + 0.3) - 0.4)
    lid = np.maximum(g.disc(0.1, 0.42, 0.03), 0.05 - g.x)
    spout = union(g.rod((0.38, 0, -0.5), (0.9, 0, 0.25), 0.06), g.rod((0.88, 0, 0.22), (0.93, 0, 0.3), 0.13))
    handle, top = g.ring((-0.4, 0, -0.28), 0.3, 0.035, 1), g.ring((0, 0, 0.1), 0.38, 0.035, 1)
    outside = np.maximum(g.around - 0.41, np.abs(g.z + 0.3) - 0.39)
    return union(wall, lid, g.disc(-0.7, 0.42, 0.04), *(np.maximum(part, -outside) for part in (spout, handle, top)))


def rings(g: Grid) -> Field:
    """Four parts one above another that do not touch, the gaps as narrow as a twentieth."""
    return union(
        *(g.ring((0, 0, z), radius, 0.13) for z, radius in ((-0.5, 0.68), (-0.19, 0.56), (0.12, 0.44), (0.43, 0.32)))
    )


def bottle(g: Grid) -> Field:
    """A wide belly behind a long narrow neck, hollow, with a handle between them."""
    radius = 0.14 + 0.32 / (1 + np.exp(14 * (g.z - 0.1)))
    wall = np.maximum(0.6 * np.abs(g.around - radius) - 0.025, np.abs(g.z) - 0.85)
    handle = np.maximum(g.ring((0.3, 0, 0.25), 0.28, 0.035, 1), -0.6 * (g.around - radius))
    return union(wall, g.disc(-0.83, 0.47, 0.05), handle)


def helix(g: Grid) -> Field:
    """A spring: a thin wire of five turns whose coils do not touch, with a plate at each end."""
    turns = np.linspace(0, 5 * math.tau, 160)
    path = np.stack([0.5 * np.cos(turns), 0.5 * np.sin(turns), np.linspace(-0.7, 0.7, len(turns))], axis=1)
    return union(g.disc(-0.75, 0.62, 0.05), g.disc(0.75, 0.62, 0.05), *(g.rod(a, b, 0.045) for a, b in pairwise(path)))


def jug(g: Grid) -> Field:
    """A belly under a neck, hollow, with a handle."""
    radius = 0.36 + 0.1 * np.sin(3 * (g.z + 0.2))
    wall = np.maximum(0.85 * np.abs(g.around - radius) - 0.035, np.abs(g.z) - 0.7)
    handle = np.maximum(g.ring((-0.42, 0, 0.05), 0.34, 0.045, 1), -0.85 * (g.around - radius))
    return union(wall, g.disc(-0.68, 0.3, 0.05), handle)


def goblet(g: Grid) -> Field:
    """A deep cup with a thin wall on a stem and a foot."""
    egg = np.sqrt((g.around / 0.42) ** 2 + ((g.z - 0.35) / 0.5) ** 2) - 1
    cup = np.maximum(0.4 * np.abs(egg) - 0.03, g.z - 0.55)
    return union(cup, g.rod((0, 0, -0.15), (0, 0, -0.75), 0.05), g.disc(-0.78, 0.36, 0.04))


SHAPES: dict[str, Callable[[Grid], Field]] = {
    shape.__name__: shape
    for shape in (
        *(chair, chain, bowl, vase, plant, gear, cage, plate, figures),
        *(teapot, comb, clasp, basket, shelf),
        *(cottage, tree, violin, well),
        *(bucket, glasses, lantern, pretzel, book, can, rings, bottle, helix),
        *(jug, goblet),
    )
}
