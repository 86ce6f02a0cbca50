"""Hollows between walls that are about as thick everywhere: mugs, bowls and pots, whose lids may not be pushed in.

Of a deep hollow photos see the walls at a slant, and few its bottom. So the whole of it is supposed at once: all that
is farther than a wall's thickness from the hull, but for the lid, is free. Photos that look in through the lid agree on
such walls where they are that thick, and hardly where they are not: their texture correlates, or, where all is plain,
each place has one colour.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.data.agreement import SMOOTH, Looked, averaged, looked_at
from etsplat.data.dataset import Dataset
from etsplat.data.passages import through_wide_passages
from etsplat.data.photos import pixel_size
from etsplat.data.same_colors import local_sameness
from etsplat.data.through_lids import LEVEL, Surface, ThroughLid, distance_from
from etsplat.data.visual_hull import Distance, outside_hull
from etsplat.geometry.measures import area_normals, face_areas, vertex_normals
from etsplat.geometry.topology import connected

_LID, _LIDS = 0.6, 3
"""Correlation below which a vertex may be a lid's, and how many of the largest are looked at."""

_UNLIKE = 0.3
"""Sameness of colours below which it may be one's, too: on lids it is about 0, on surfaces 0.4 to 1."""

_LARGE = 0.01
"""Of the surface, what a lid covers at least."""

_BELOW = 12
"""Pixels under a lid at which the hull goes on: on thin limbs photos agree little, too."""

_PIXELS = (*range(2, 20, 2), 21, 24, 27, 30, 34, 38)
"""Thicknesses that are tried, and those a pixel beside the best: agreement is about three pixels wide."""

ON_WALLS, _PEAK = 0.5, 0.3
"""Mean correlation on walls, at least, which are seen at a slant; and by so much more than on the lid, or at the least
likely thickness."""

_SAME = 0.8
"""Sameness of colours on walls, at least, and by `_PEAK` more than on the lid."""

_SHEET = 0.75
"""What the sameness on walls lacks of 1 is so many times what it lacks on a sheet without thickness, at most."""

_EVERY, _ROUGHLY = 4, 0.15
"""First one in so many places is asked: where photos agree less than they must by more than that, no more are."""

_CLEAR, _THICKER = 0.8, 0.1
"""Mean correlation on a bottom that is not as thick as the walls, at least; and by so much more than if it were."""

_LESS = 0.9
"""Or what sameness lacks of 1 is so many times as much at most."""

_BESIDE = 3
"""Pixels beside where photos contradict a lid that are the lid's, too: of walls right behind it they see the like."""

_THICK = 1.5
"""Mean edges of the hull: thinner walls would have holes once they are meshed."""


@dataclass(frozen=True)
class _Walls:
    """Walls around a hollow under a lid.

    Attributes:
        vertices: (V, 3) of all.
        lid: (L, 3) faces over what is free.
        rim: (R, 3) those around it that are as level, as far as the sides.
        bottom: (B, 3) those of the others that look down where a lid looks up.
        sides: (F, 3) all others.
        thickness: of the walls.
        floor: thickness of the bottom.
    """

    vertices: Float[Tensor, "V 3"]
    lid: Int64[Tensor, "L 3"]
    rim: Int64[Tensor, "R 3"]
    bottom: Int64[Tensor, "B 3"]
    sides: Int64[Tensor, "F 3"]
    thickness: float
    floor: float

    def beyond(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """How far points are farther than walls are thick from all but the lid, and under it from all but the rim.

        Measured from a rim, too, walls would have a brim there.
        """
        lid, rim, bottom, sides = (surface.distance(points) for surface in self._surfaces)
        around = torch.minimum(bottom - self.floor, sides - self.thickness)
        return torch.where(lid < rim, around, torch.minimum(rim - self.thickness, around))

    @cached_property
    def _surfaces(self) -> list[Surface]:
        return [Surface(self.vertices, faces) for faces in (self.lid, self.rim, self.bottom, self.sides)]

    def hollow(self, outside: Distance) -> Distance:
        """The same of the hollow under the lid alone, which ends at passages no wider than both walls beside them."""
        opening = self.vertices[self.lid].mean(dim=1)
        return through_wide_passages(self.beyond, outside, opening, self.vertices, self.thickness)


@torch.no_grad()
def between_walls(
    dataset: Dataset,
    vertices: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    agreed: float = ON_WALLS,
    pushed: Float[Tensor, "V 3"] | None = None,
) -> Distance | None:
    """How far points within a hull are beyond its walls, in hollows whose walls photos agree on: positive there.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        vertices: (V, 3) of the hull.
        faces: (F, 3) of it.
        agreed: mean correlation on walls, at least.
        pushed: (V, 3) vertices once lids are pushed in, if these are not. Walls are as far from what was pushed in
            elsewhere than at their own lid: the cone that a hull has under an object is not its bottom.

    Returns:
        A function of points; None where there is no such hollow.
    """

    def walls(looked: Looked, lid: Tensor, moved: Tensor) -> _Walls | None:
        return _textured(ThroughLid(looked, lid, moved), agreed)

    return _between(dataset, vertices, faces, pushed, lambda looked: looked.score < _LID, walls)


@torch.no_grad()
def between_plain_walls(
    dataset: Dataset,
    vertices: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    pushed: Float[Tensor, "V 3"] | None = None,
) -> Distance | None:
    """The same of walls each place of which has one colour in all photos, as shading gives things that are plain.

    Walls without thickness are none: those who look onto the inner side of an open sheet through a lid see such.
    """

    def walls(looked: Looked, lid: Tensor, moved: Tensor) -> _Walls | None:
        # Beside the walls it hides a lid shows nearly what they do: all that is level may be one.
        tried = (_plain(ThroughLid(looked, some, moved)) for some in (_with_level(lid, vertices, faces), lid))
        return max(tried, key=lambda each: each[0])[1]

    return _between(dataset, vertices, faces, pushed, lambda looked: local_sameness(looked) < _UNLIKE, walls)


def _between(
    dataset: Dataset,
    vertices: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    pushed: Float[Tensor, "V 3"] | None,
    unlike: Callable[[Looked], Bool[Tensor, " V"]],
    walls: Callable[[Looked, Bool[Tensor, " F"], Float[Tensor, "V 3"]], _Walls | None],
) -> Distance | None:
    """How far points are in the hollow in which they are deepest; None if there is none.

    Args:
        dataset: photos.
        vertices: (V, 3) of the hull.
        faces: (F, 3) of it.
        pushed: (V, 3) vertices once lids are pushed in; None if these are.
        unlike: which vertices may be a lid's.
        walls: those around the hollow under a lid, if there are any.
    """
    looked = looked_at(dataset, vertices, faces)
    if looked is None:
        return None
    outside, moved = outside_hull(dataset), vertices if pushed is None else pushed
    found = [walls(looked, lid, moved) for lid in _lids(looked, unlike(looked), outside)]
    hollows = [around.hollow(outside) for around in found if around is not None]
    if not hollows:
        return None
    return lambda points: torch.stack([free(points) for free in hollows]).amax(dim=0)


def _lids(looked: Looked, unlike: Bool[Tensor, " V"], outside: Distance) -> list[Bool[Tensor, " F"]]:
    """The largest patches on which photos do not agree, each with a ring of faces around it."""
    vertices, faces, edges = looked.vertices, looked.faces, looked.topology.edges.long()
    inward = -averaged(vertex_normals(vertices, faces), edges, SMOOTH)
    lid = unlike & (outside(vertices + _BELOW * pixel_size(looked.photos) * inward) < 0)
    count, patch = connected(edges[lid[edges].all(dim=1)], len(vertices))
    within, area = lid[faces].all(dim=1), face_areas(vertices, faces)
    sizes = torch.zeros(count).index_add(0, patch[faces[within, 0]], area[within]) / area.sum()
    largest = sizes.topk(min(_LIDS, count))
    return [
        torch.isin(faces, faces[within & (patch[faces[:, 0]] == number)].unique()).any(dim=1)
        for size, number in zip(*largest, strict=True)
        if size >= _LARGE
    ]


def _with_level(
    lid: Bool[Tensor, " F"], vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> Bool[Tensor, " F"]:
    """A lid with all faces that look up as it does and hang together with it."""
    up = normalize(area_normals(vertices, faces[lid]).sum(dim=0), dim=0)
    level = lid | (normalize(area_normals(vertices, faces), dim=1) @ up > LEVEL)
    corners = faces[level]
    _, patch = connected(torch.cat([corners[:, :2], corners[:, 1:]]), len(vertices))
    return level & torch.isin(patch[faces[:, 0]], patch[faces[lid]])


def _textured(through: ThroughLid, least: float) -> _Walls | None:
    """The walls around the hollow under a lid; None where photos correlate on none."""
    if not _may_reach(least, through.thinned(_EVERY).agreed):
        return None
    best, agreed = _likeliest(through.agreed)
    lowest = min([through.closed(), *(each for each in agreed.values() if each > 0)])
    if agreed[best] < max(least, lowest + _PEAK):
        return None
    deepest, floors = _likeliest(through.floor_agreed)
    clear = floors[deepest] >= max(_CLEAR, floors.get(best, through.floor_agreed(best)) + _THICKER)
    return _around(through, best, deepest if clear else best)


def _plain(through: ThroughLid) -> tuple[float, _Walls | None]:
    """The same, where each place of walls has one colour, and how far it has; 0 where there are none.

    Nor are there any where texture is known and tells otherwise.
    """
    rough = through.thinned(_EVERY)
    if not _may_reach(_SAME, lambda pixels: rough.sameness(pixels, pixels, pixels)):
        return 0.0, None
    rim, same = _likeliest(lambda pixels: through.sameness(pixels, pixels, pixels))
    if same[rim] < max(_SAME, through.closed_sameness(rim) + _PEAK):
        return 0.0, None
    # The same photos are asked of all: thinner walls leave less of a rim out.
    thinner = {pixels: through.sameness(pixels, pixels, rim) for pixels in (0, *same) if pixels <= rim}
    best = max(thinner, key=thinner.__getitem__)
    correlated = through.agreed(best)
    if 1 - thinner[best] > _SHEET * (1 - thinner[0]) or (correlated != 0 and correlated < _LID):
        return 0.0, None
    deepest, floors = _likeliest(lambda pixels: through.sameness(best, pixels, rim))
    clear = 1 - floors[deepest] <= _LESS * (1 - thinner[best])
    return thinner[best], _around(through, best, deepest if clear else best)


def _may_reach(least: float, agreed: Callable[[int], float]) -> bool:
    """Whether photos may agree so much at some thickness, as far as some of the places tell; if none do, they may."""
    best = max(agreed(pixels) for pixels in _PIXELS)
    return best == 0 or best >= least - _ROUGHLY


def _likeliest(agreed: Callable[[int], float]) -> tuple[int, dict[int, float]]:
    """The thickness in pixels at which photos agree most, and what they do at those that were tried."""
    found = {pixels: agreed(pixels) for pixels in _PIXELS}
    middle = max(found, key=found.__getitem__)
    found |= {pixels: agreed(pixels) for pixels in (max(2, middle - 1), middle + 1)}
    return max(found, key=found.__getitem__), found


def _around(through: ThroughLid, pixels: int, floor: int) -> _Walls:
    """Walls and a bottom around what is under a lid, so thick, but no thinner than a mesh of them can be."""
    return _walls(through, *(max(each * through.pixel, _THICK * through.edge) for each in (pixels, floor)))


def _walls(through: ThroughLid, thickness: float, floor: float) -> _Walls:
    """So thick ones around what is under a lid, with what is beside it, where that is level and not on walls."""
    vertices, rest, beside = through.elsewhere, through.rest, _BESIDE * through.pixel
    lid = through.lid[through.level(through.lid)]
    away = distance_from(vertices[rest].mean(dim=1), vertices, lid)
    around = through.level(rest) & (away <= thickness + beside)
    sides, above = rest[~around], torch.cat([lid, rest[around & (away <= beside)]])
    below = vertices[above].mean(dim=1) - 2 * thickness * through.up
    on_walls = distance_from(below, vertices, sides) <= thickness
    rim = torch.cat([rest[around & (away > beside)], above[on_walls]])
    bottom = through.bottom(sides)
    return _Walls(vertices, above[~on_walls], rim, sides[bottom], sides[~bottom], thickness, floor)
