"""Things of a household, made when all other solids had been looked at often."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from benchmarks.unseen_objects import more_shapes
from benchmarks.unseen_objects.shapes import Field, Grid, union


def headphones(g: Grid) -> Field:
    """A band over two cups with soft rings: one thin arch, hollows that face each other."""
    band = np.maximum(np.maximum(np.abs(np.hypot(g.x, g.z) - 0.75) - 0.035, np.abs(g.y) - 0.1), -g.z)
    cups, around = [], np.hypot(g.y, g.z + 0.1)
    for side in (-1, 1):
        shell = np.maximum(around - 0.35, np.abs(g.x - side * 0.72) - 0.12)
        hollow = np.maximum(around - 0.2, np.abs(g.x - side * 0.55) - 0.2)
        cups.append(np.maximum(shell, -hollow))
    return union(band, *cups)


def birdhouse(g: Grid) -> Field:
    """A hollow box with a gable, a round hole in its front, a perch."""
    roof = (np.abs(g.x) + g.z - 0.75) / math.sqrt(2)
    outside = np.maximum(g.block((0, 0, 0), (0.45, 0.4, 0.75)), roof)
    inside = np.maximum(g.block((0, 0, 0), (0.36, 0.31, 0.66)), roof + 0.1)
    hole = np.maximum(np.hypot(g.x, g.z - 0.15) - 0.17, g.y)
    return union(np.maximum(outside, -np.minimum(inside, hole)), g.rod((0, -0.35, -0.2), (0, -0.7, -0.2), 0.04))


def fork(g: Grid) -> Field:
    """Four tines on a bent handle, everything thin."""
    parts = [g.rod((0, 0.2, 0.05), (0, 0.95, 0.15), 0.05), g.rod((0, -0.1, 0.0), (0, 0.25, 0.06), 0.06)]
    parts.append(g.rod((-0.18, -0.15, 0), (0.18, -0.15, 0), 0.05))
    for x in (-0.18, -0.06, 0.06, 0.18):
        parts += [g.rod((x, -0.15, 0), (x, -0.55, -0.08), 0.033), g.rod((x, -0.55, -0.08), (x, -0.95, 0.0), 0.03)]
    return union(*parts)


def candelabrum(g: Grid) -> Field:
    """A stem with three arms that end in cups, on a round foot."""
    parts = [g.disc(-0.9, 0.4, 0.05), g.rod((0, 0, -0.9), (0, 0, 0.5), 0.06)]
    tops = [(0.0, 0.0, 0.55)]
    for k in range(3):
        c, s = math.cos(2.1 * k), math.sin(2.1 * k)
        parts += [
            g.rod((0, 0, -0.3), (0.45 * c, 0.45 * s, -0.2), 0.045),
            g.rod((0.45 * c, 0.45 * s, -0.2), (0.6 * c, 0.6 * s, 0.15), 0.045),
        ]
        tops.append((0.6 * c, 0.6 * s, 0.2))
    solid = union(*parts)
    for x, y, z in tops:
        far = g.pillar(x, y)
        cup = np.maximum(far - 0.15, np.abs(g.z - z - 0.1) - 0.12)
        solid = np.maximum(np.minimum(solid, cup), -np.maximum(far - 0.1, z + 0.03 - g.z))
    return solid


def armchair(g: Grid) -> Field:
    """A seat between arms and a back, four stubby legs."""
    parts = [
        g.block((0, 0, -0.35), (0.6, 0.55, 0.2), 0.05),
        g.block((0, 0.5, 0.15), (0.6, 0.12, 0.6), 0.06),
        g.block((-0.55, 0, -0.1), (0.11, 0.55, 0.38), 0.05),
        g.block((0.55, 0, -0.1), (0.11, 0.55, 0.38), 0.05),
    ]
    parts += [g.rod((x, y, -0.5), (x, y, -0.7), 0.07) for x in (-0.5, 0.5) for y in (-0.42, 0.45)]
    return union(*parts)


def crown(g: Grid) -> Field:
    """A band that is open above and below, with seven spikes that end in balls."""
    top = 0.15 + 0.3 * np.abs(np.cos(3.5 * np.arctan2(g.y, g.x)))
    wall = np.abs(g.around - 0.75 - 0.12 * g.z) - 0.05
    band = np.maximum(np.maximum(wall, g.z - top), -0.4 - g.z) * 0.8
    angles = (math.tau * k / 7 for k in range(7))
    return union(band, *(g.ball((0.81 * math.cos(a), 0.81 * math.sin(a), 0.5), 0.085) for a in angles))


def boat(g: Grid) -> Field:
    """An open hull with pointed ends, two benches across it, an oar that lies over them."""
    wide = np.maximum(0.42 * (1 - g.x**2), 0.02)
    deep = 0.4 * (1 - 0.5 * g.x**2)
    hull = (np.sqrt((g.y / wide) ** 2 + (np.minimum(g.z, 0) / deep) ** 2) - 1) * wide
    outer = np.maximum(np.maximum(hull, g.z - 0.15), np.abs(g.x) - 0.93)
    inner = np.maximum(np.maximum(hull + 0.07, -0.3 - g.z), np.abs(g.x) - 0.85)
    shell = np.maximum(outer, -inner) * 0.7
    benches = [np.maximum(g.block((x, 0, 0.05), (0.1, 0.5, 0.035)), outer) for x in (-0.3, 0.35)]
    return union(shell, *benches, g.rod((-0.75, -0.05, 0.13), (0.75, 0.1, 0.13), 0.035))


def mugs(g: Grid) -> Field:
    """Two, one stands on its head beside the other; they do not touch."""
    both = []
    for x, up in ((-0.48, 1.0), (0.48, -1.0)):
        far = g.pillar(x, 0)
        cup = np.maximum(far - 0.38, np.abs(g.z) - 0.45)
        hollow = np.maximum(far - 0.31, -0.37 - up * g.z)
        handle = np.maximum(g.ring((x, -0.42, 0), 0.22, 0.05, axis=0), 0.34 - far)
        both.append(np.minimum(np.maximum(cup, -hollow), handle))
    return np.minimum(*both)


def tap(g: Grid) -> Field:
    """A bent pipe on a foot, hollow at its end, with two handles like crosses."""
    parts = [g.disc(-0.75, 0.3, 0.08), g.rod((0, 0, -0.75), (0, 0, 0.3), 0.11)]
    bow = np.maximum(np.hypot(np.hypot(g.x - 0.35, g.z - 0.3) - 0.35, g.y) - 0.11, 0.3 - g.z)
    parts += [bow, g.rod((0.7, 0, 0.3), (0.7, 0, 0.1), 0.11)]
    for y in (-0.4, 0.4):
        parts += [g.rod((0, 0, -0.45), (0, y, -0.45), 0.06), g.rod((0, y, -0.45), (0, y, -0.2), 0.06)]
        parts += [g.rod((-0.18, y, -0.2), (0.18, y, -0.2), 0.04), g.rod((0, y - 0.18, -0.2), (0, y + 0.18, -0.2), 0.04)]
    mouth = np.maximum(g.pillar(0.7, 0) - 0.075, g.z - 0.25)
    return np.maximum(union(*parts), -mouth)


def stairs(g: Grid) -> Field:
    """A spiral: eighteen steps around a pole, with a rail on rods."""
    parts, tops = [g.rod((0, 0, -0.95), (0, 0, 0.95), 0.08)], []
    for k in range(18):
        a, z = 0.42 * k, -0.85 + 0.1 * k
        c, s = math.cos(a), math.sin(a)
        along, across = c * g.x + s * g.y, -s * g.x + c * g.y
        step = np.maximum(np.maximum(np.abs(along - 0.3) - 0.3, np.abs(across) - 0.13), np.abs(g.z - z) - 0.03)
        tops.append((0.57 * c, 0.57 * s, z + 0.2))
        parts += [step, g.rod((0.57 * c, 0.57 * s, z), tops[-1], 0.02)]
    return union(*parts, *(g.rod(a, b, 0.025) for a, b in pairwise(tops)))


SHAPES: dict[str, Callable[[Grid], Field]] = more_shapes.SHAPES | {
    shape.__name__: shape
    for shape in (headphones, birdhouse, crown, candelabrum, boat, stairs, mugs, tap, armchair, fork)
}
"""Those of `shapes` and `more_shapes`, too."""
