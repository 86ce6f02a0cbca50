"""More solids, made when those of `shapes` had been looked at often."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from benchmarks.unseen_objects import shapes
from benchmarks.unseen_objects.shapes import Field, Grid, union


def trophy(g: Grid) -> Field:
    """A cup with two handles, on a stem and a square foot."""
    egg = np.sqrt((g.around / 0.45) ** 2 + ((g.z - 0.4) / 0.6) ** 2) - 1
    cup = np.maximum(0.4 * np.abs(egg) - 0.025, g.z - 0.6)
    handles = [np.maximum(g.ring((0.47 * side, 0, 0.3), 0.2, 0.035, 1), -0.4 * egg) for side in (-1, 1)]
    return union(cup, *handles, g.rod((0, 0, -0.18), (0, 0, -0.7), 0.07), g.block((0, 0, -0.75), (0.3, 0.3, 0.07)))


def room(g: Grid) -> Field:
    """A hollow box, closed but for a window in one side: dark within."""
    walls = np.maximum(g.block((0, 0, 0), (0.6, 0.45, 0.45)), -g.block((0, 0, 0), (0.53, 0.38, 0.38)))
    return np.maximum(walls, -g.block((0.1, -0.45, 0.05), (0.26, 0.2, 0.2), 0))


def shoe(g: Grid) -> Field:
    """A slipper: a sole, a toe that is closed above, an opening at the heel through which nobody sees the toe."""
    outside = union(
        g.ellipsoid((0.25, 0, -0.2), np.eye(3), (0.6, 0.27, 0.28)),
        g.ellipsoid((-0.4, 0, -0.05), np.eye(3), (0.36, 0.24, 0.45)),
    )
    inside = union(
        g.ellipsoid((0.25, 0, -0.2), np.eye(3), (0.53, 0.21, 0.22)),
        g.ellipsoid((-0.4, 0, -0.05), np.eye(3), (0.3, 0.18, 0.42)),
    )
    upper = np.maximum(np.maximum(outside, -inside), np.maximum(g.z - 0.12, -0.4 - g.z))
    sole = np.maximum(outside, np.abs(g.z + 0.38) - 0.05)
    return union(upper, sole)


def lampshade(g: Grid) -> Field:
    """A thin cone that is open above and below, held by a rod through a ring of spokes, over a foot."""
    cone = np.maximum(0.9 * np.abs(g.around - (0.42 - 0.35 * (g.z - 0.4))) - 0.022, np.abs(g.z - 0.4) - 0.32)
    spokes = [
        g.rod((0, 0, 0.6), (0.36 * math.cos(angle), 0.36 * math.sin(angle), 0.6), 0.025)
        for angle in math.tau * np.arange(3) / 3
    ]
    return union(cone, *spokes, g.rod((0, 0, 0.6), (0, 0, -0.75), 0.045), g.disc(-0.78, 0.4, 0.05))


def elbow(g: Grid) -> Field:
    """A pipe with a bend that nobody sees through, with a flange at each end: one hole."""
    bend = np.hypot(np.hypot(g.x + 0.35, g.z + 0.35) - 0.55, g.y)
    quarter = np.maximum(-0.35 - g.x, -0.35 - g.z)
    legs = [(np.hypot(g.z - 0.2, g.y), g.x), (np.hypot(g.x - 0.2, g.y), g.z)]
    outside, inside = np.maximum(bend - 0.22, quarter), np.maximum(bend - 0.16, quarter)
    for away, along in legs:
        outside = union(outside, np.maximum(away - 0.22, np.abs(along + 0.55) - 0.22))
        outside = union(outside, np.maximum(away - 0.32, np.abs(along + 0.73) - 0.04))
        inside = union(inside, np.maximum(away - 0.16, np.abs(along + 0.6) - 0.27))
    return np.maximum(outside, -inside)


def folder(g: Grid) -> Field:
    """A sheet folded four times like a fan, that stands upright."""
    corners = [(-0.7, -0.25), (-0.35, 0.25), (0.0, -0.25), (0.35, 0.25), (0.7, -0.25)]
    panels = []
    for (ax, ay), (bx, by) in pairwise(corners):
        way = np.array((bx - ax, by - ay))
        along = np.clip(((g.x - ax) * way[0] + (g.y - ay) * way[1]) / (way @ way), 0, 1)
        panels.append(np.hypot(g.x - ax - along * way[0], g.y - ay - along * way[1]) - 0.025)
    return np.maximum(union(*panels), np.abs(g.z) - 0.6)


def tray(g: Grid) -> Field:
    """A flat bottom, a low rim, two handles that stand on it."""
    rim = np.maximum(g.block((0, 0, 0), (0.75, 0.5, 0.12)), -g.block((0, 0, 0.1), (0.7, 0.45, 0.15)))
    handles = [np.maximum(g.ring((0.72 * side, 0, 0.1), 0.16, 0.03, 0), 0.06 - g.z) for side in (-1, 1)]
    return union(rim, *handles)


def chess(g: Grid) -> Field:
    """Five separate pieces on no board: pawns, and a rook whose top is hollow."""
    parts = []
    for x, y in ((-0.55, -0.4), (0.55, -0.4), (-0.55, 0.45), (0.5, 0.5)):
        foot = np.maximum(g.pillar(x, y) - 0.2, np.abs(g.z + 0.4) - 0.06)
        parts += [foot, g.rod((x, y, -0.4), (x, y, 0.05), 0.08), g.ball((x, y, 0.15), 0.14)]
    tower = np.maximum(np.maximum(g.around - 0.22, np.abs(g.z) - 0.46), -np.maximum(g.around - 0.15, 0.2 - g.z))
    for x, y in ((1, 0), (0, 1)):
        notch = np.maximum(np.abs(y * g.x + x * g.y) - 0.05, 0.34 - g.z)
        tower = np.maximum(tower, -notch)
    return union(*parts, tower)


SHAPES: dict[str, Callable[[Grid], Field]] = shapes.SHAPES | {
    shape.__name__: shape for shape in (trophy, room, shoe, lampshade, elbow, folder, tray, chess)
}
"""Those of `shapes`, too."""
