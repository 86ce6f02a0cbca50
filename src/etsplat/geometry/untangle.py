"""Undoing self-intersections: sheets that cross are pushed apart, and what that leaves is smoothed or stays."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.geometry.inside_out import inside_out, turned_out
from etsplat.geometry.intersections import IntersectionSearch
from etsplat.geometry.separation import separated
from etsplat.geometry.topology import MeshTopology

_TANGLED = 0.2
"""Fraction of faces that intersect, above which none is pushed: such a mesh is no solid whose sheets have sides, and
its pairs of faces are too many to look at."""

_PUSHES = 32
"""Rounds of pushing apart."""

_SETTLE = 6
"""After so many of them what still intersects moves half as far as a sweep of smoothing: pushes that contradict each
other end."""

_SWEEPS = 2
"""Smoothing sweeps between two looks for intersections: more move vertices farther than needed, fewer look longer."""

_WIDEN = 8
"""Rounds after which the region grows by a ring of neighbours."""

_STEP = 0.5
"""How far a sweep moves a vertex towards the mean of its neighbours."""

_RETURNS = 12
"""Attempts to bring vertices back; each halves the way that is left to those that get through."""

_SHORTEST = 0.02
"""Part of the way, of all that smoothing moved a vertex, below which no attempt is worth its looks."""

_HOLDS = 6
"""Looks for intersections in an attempt, each holding more vertices in place."""


def untangle(
    vertices: Float[Tensor, "V 3"], topology: MeshTopology, *, rounds: int = 40, reach: float = math.inf
) -> tuple[Float[Tensor, "V 3"], int]:
    """Moves the vertices of faces that cut through others until none does, as little as possible.

    1. Thin parts that are inside out are turned right (`inside_out`): the surface stays where it is. What follows is
       done with that, and where faces still intersect without it too; the result with fewer of them is taken.
    2. In rounds, sheets that cross are pushed apart (`separation.separated`): most cross by a small part of an edge, so
       that nobody sees it. Every few rounds the corners of what still intersects are smoothed a little.
    3. What that leaves is smoothed in rounds: the corners of intersecting faces, with a ring of neighbours for every
       eighth round already done, so that what resists is smoothed more widely, move to the mean of their neighbours in
       damped sweeps.
    4. What moved goes back towards its old place, as far as that makes no face intersect anew: folds end where they
       touch instead of flat.
    5. Where a vertex still ends too far away, all that moved together with it returns to its old place, intersections
       included: folds so large hold up the shape, as where a sphere stands for an object with holes.

    All other vertices stay where they are. Boundary vertices may shrink inwards. Computed on the CPU.

    Args:
        vertices: (V, 3) finite.
        topology: of the mesh.
        rounds: most looks for intersections in step 3.
        reach: how far a vertex may go after step 1, in lengths of its longest edge, or of two mean edges of the mesh if
            that is more: where it is folded its own are short.

    Returns:
        Moved vertices, and how many faces still intersect.
    """
    original, topology = vertices.detach().cpu(), topology.to(torch.device("cpu"))
    search = IntersectionSearch(topology.faces)
    marked = search(original)
    wrong = inside_out(original.double(), topology, marked)
    turned = turned_out(original.double(), topology, wrong).to(original)
    starts = [original] if torch.equal(turned, original) else [turned, original]
    found, left = original, math.inf
    for start in starts:
        moved, still = _apart(start, topology, search, rounds, reach)
        if still < left:
            found, left = moved, still
        if left == 0:
            break
    return found.to(vertices.device), int(left)


def _apart(
    original: Float[Tensor, "V 3"], topology: MeshTopology, search: IntersectionSearch, rounds: int, reach: float
) -> tuple[Float[Tensor, "V 3"], int]:
    """Steps 2 to 5 of `untangle`."""
    moved = original.clone()
    marked = search(moved)
    for done in range(1, _PUSHES + 1):
        if not 0 < float(marked.float().mean()) <= _TANGLED:
            break
        moved = separated(moved.double(), topology, marked).to(original)
        if done % _SETTLE == 0:
            _smooth(moved, topology, _region(marked, topology, rings=0), sweeps=1, step=0.5 * _STEP)
        marked = search(moved)
    for done in range(rounds):
        if not bool(marked.any()):
            break
        _smooth(moved, topology, _region(marked, topology, rings=done // _WIDEN))
        marked = search(moved)
    moved = _returned(moved, original, topology, search, marked)
    lost = _too_far(moved, original, topology, reach)
    if bool(lost.any()):
        moved[lost] = original[lost]
        marked = search(moved)
    return moved, int(marked.sum())


def _returned(
    vertices: Float[Tensor, "V 3"],
    original: Float[Tensor, "V 3"],
    topology: MeshTopology,
    search: IntersectionSearch,
    marked: Bool[Tensor, " F"],
) -> Float[Tensor, "V 3"]:
    """The vertices brought back towards `original` as far as no faces intersect but those that are marked."""
    still = (vertices == original).all(dim=1)
    way, step = torch.zeros(len(vertices)), torch.full((len(vertices),), 0.5)
    for _ in range(_RETURNS):
        aim = torch.where(still, way, way + step * (1 - way))
        if float((aim - way).max()) < _SHORTEST:
            break
        held = still
        for _ in range(_HOLDS):
            trial = vertices.lerp(original, torch.where(held, way, aim)[:, None])
            new = search(trial) & ~marked
            if not bool(new.any()):
                break
            corners = _region(new, topology, rings=0)
            held = held | corners if bool((corners & ~held).any()) else _grown(held, topology)
        else:
            held = torch.ones_like(still)
        way, step = torch.where(held, way, aim), torch.where(held, 0.5 * step, step)
    return vertices.lerp(original, way[:, None])


def _too_far(
    vertices: Float[Tensor, "V 3"], original: Float[Tensor, "V 3"], topology: MeshTopology, reach: float
) -> Bool[Tensor, " V"]:
    """Vertices that moved together, by edges, with one that moved too far."""
    first, second = topology.edges.cpu().unbind(1)
    lengths = (original[first] - original[second]).norm(dim=1)
    unit = (2.0 * lengths.mean()).repeat(len(original))
    for end in (first, second):
        unit.scatter_reduce_(0, end, lengths, "amax")
    distance = (vertices - original).norm(dim=1)
    moved, lost = distance > 0, distance > reach * unit
    while True:
        grown = _grown(lost, topology) & moved
        if torch.equal(grown, lost):
            return lost
        lost = grown


def _region(faces: Bool[Tensor, " F"], topology: MeshTopology, rings: int) -> Bool[Tensor, " V"]:
    """The corners of some faces, and so many rings of neighbours."""
    region = torch.zeros(topology.num_vertices, dtype=torch.bool)
    region[topology.faces.cpu()[faces].reshape(-1)] = True
    for _ in range(rings):
        region = _grown(region, topology)
    return region


def _grown(region: Bool[Tensor, " V"], topology: MeshTopology) -> Bool[Tensor, " V"]:
    """With a ring of neighbours more."""
    first, second = topology.edges.cpu().unbind(1)
    grown = region.clone()
    grown[second[region[first]]] = True
    grown[first[region[second]]] = True
    return grown


def _smooth(
    vertices: Tensor, topology: MeshTopology, region: Bool[Tensor, " V"], sweeps: int = _SWEEPS, step: float = _STEP
) -> None:
    """Damped sweeps over the vertices of a region, in place."""
    counts = topology.neighbor_offsets.cpu().diff()
    owner = torch.repeat_interleave(torch.arange(topology.num_vertices), counts)
    inside = region[owner]
    owner, neighbors = owner[inside], topology.neighbor_indices.cpu()[inside]
    moved = region & (counts > 0)
    for _ in range(sweeps):
        sums = torch.zeros_like(vertices).index_add_(0, owner, vertices[neighbors])
        means = sums[moved] / counts[moved, None]
        vertices[moved] += step * (means - vertices[moved])
