"""Hollows between walls that are about as thick everywhere: mugs, bowls and pots, whose lids may not be pushed in.

Of a deep hollow photos see the walls at a slant, and few its bottom. So the whole of it is supposed at once: all that
is farther than a wall's thickness from the hull, but for the lid, is free. Photos that look in through the lid agree on
such walls where they are that thick, and hardly where they are not.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.data.agreement import Looked, agreement, averaged, first_hits, looked_at, pixel_size
from etsplat.data.dataset import Dataset
from etsplat.data.passages import through_wide_passages
from etsplat.data.visual_hull import Distance, outside_hull
from etsplat.geometry.distance import closest_points
from etsplat.geometry.measures import area_normals, face_areas, mean_edge, vertex_normals
from etsplat.geometry.topology import connected

_LID, _LIDS = 0.6, 3
"""Correlation below which a vertex may be a lid's, and how many of the largest are looked at."""

_LARGE = 0.01
"""Of the surface, what a lid covers at least."""

_BELOW = 12
"""Pixels under a lid at which the hull goes on: on thin limbs photos agree little, too."""

_PIXELS = (*range(2, 20, 2), 21, 24, 27, 30, 34, 38)
"""Thicknesses that are tried, and those a pixel beside the best: agreement is about three pixels wide."""

_SMOOTH = 3
"""Rounds in which normals are averaged with their neighbours'."""

_ALONE = 0.9
"""A place is on a wall if nothing else of the surface is nearer than this, in units of the thickness."""

ON_WALLS, _PEAK = 0.5, 0.3
"""Mean correlation on walls, at least, which are seen at a slant; and by so much more than on the lid, or at the least
likely thickness."""

_CLEAR, _THICKER = 0.8, 0.1
"""Mean correlation on a bottom that is not as thick as the walls, at least; and by so much more than if it were."""

_LEVEL = 0.7
"""Cosine of the angle between a lid's mean normal and those of its own faces and of the rim's, at least."""

_BESIDE = 3
"""Pixels beside where photos contradict a lid that are the lid's, too: of walls right behind it they see the like."""

_THICK = 1.5
"""Mean edges of the hull: thinner walls would have holes once they are meshed."""

_KNOWN, _FEWEST = 0.2, 64
"""Of the places on walls that two photos see, so many have texture, and so many there are: else it may be chance."""


class _Walls(NamedTuple):
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
        others = (self.lid, self.rim, self.bottom, self.sides)
        lid, rim, bottom, sides = (_distance(points, self.vertices, faces) for faces in others)
        around = torch.minimum(bottom - self.floor, sides - self.thickness)
        return torch.where(lid < rim, around, torch.minimum(rim - self.thickness, around))

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
    looked = looked_at(dataset, vertices, faces)
    if looked is None:
        return None
    outside = outside_hull(dataset)
    pushed = vertices if pushed is None else pushed
    hollows = (_Through(looked, lid, pushed) for lid in _lids(looked, outside))
    found = [walls.hollow(outside) for hollow in hollows if (walls := _walls(hollow, agreed))]
    if not found:
        return None
    return lambda points: torch.stack([free(points) for free in found]).amax(dim=0)


def _lids(looked: Looked, outside: Distance) -> list[Bool[Tensor, " F"]]:
    """The largest patches on which photos do not agree, each with a ring of faces around it."""
    vertices, faces, edges = looked.vertices, looked.faces, looked.topology.edges.long()
    inward = -averaged(vertex_normals(vertices, faces), edges, _SMOOTH)
    lid = (looked.score < _LID) & (outside(vertices + _BELOW * pixel_size(looked.photos) * inward) < 0)
    count, patch = connected(edges[lid[edges].all(dim=1)], len(vertices))
    within, area = lid[faces].all(dim=1), face_areas(vertices, faces)
    sizes = torch.zeros(count).index_add(0, patch[faces[within, 0]], area[within]) / area.sum()
    largest = sizes.topk(min(_LIDS, count))
    return [
        torch.isin(faces, faces[within & (patch[faces[:, 0]] == number)].unique()).any(dim=1)
        for size, number in zip(*largest, strict=True)
        if size >= _LARGE
    ]


def _walls(through: "_Through", least: float) -> _Walls | None:
    """The walls around the hollow under a lid, no thinner than a mesh of it can be; None where photos agree on none."""
    best, agreed = _likeliest(through.agreed)
    lowest = min([through.closed, *(each for each in agreed.values() if each > 0)])
    if agreed[best] < max(least, lowest + _PEAK):
        return None
    deepest, floors = _likeliest(through.floor_agreed)
    clear = floors[deepest] >= max(_CLEAR, floors.get(best, through.floor_agreed(best)) + _THICKER)
    thickness, floor = (max(each * through.pixel, _THICK * through.edge) for each in (best, deepest if clear else best))
    return through.walls(thickness, floor)


def _likeliest(agreed: Callable[[int], float]) -> tuple[int, dict[int, float]]:
    """The thickness in pixels at which photos agree most, and what they do at those that were tried."""
    found = {pixels: agreed(pixels) for pixels in _PIXELS}
    middle = max(found, key=found.__getitem__)
    found |= {pixels: agreed(pixels) for pixels in (max(2, middle - 1), middle + 1)}
    return max(found, key=found.__getitem__), found


def _elsewhere(
    vertices: Float[Tensor, "V 3"],
    edges: Int64[Tensor, "E 2"],
    lid: Int64[Tensor, " L"],
    pushed: Float[Tensor, "V 3"],
    level: Float[Tensor, " V"],
) -> Float[Tensor, "V 3"]:
    """Vertices, where they were pushed in if that is not together with some of a lid, nor of what looks up as it does.

    Args:
        vertices: (V, 3).
        edges: (E, 2).
        lid: (L,) its vertices.
        pushed: (V, 3) where they were pushed to.
        level: (V,) cosines of the angles between their normals and the lid's.
    """
    moved = (pushed != vertices).any(dim=1)
    count, patch = connected(edges[moved[edges].all(dim=1)], len(vertices))
    mean = torch.zeros(count).index_add(0, patch, level) / patch.bincount(minlength=count)
    own = torch.isin(patch, patch[lid]) | (mean > _LEVEL)[patch]
    return torch.where((moved & ~own)[:, None], pushed, vertices)


def _distance(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """(N,) of points from some faces, infinite if there are none."""
    if len(faces) == 0:
        return points.new_full((len(points),), torch.inf)
    return closest_points(points, vertices, faces)[0].sqrt().to(points)


class _Through:
    """What photos see through a lid.

    Attributes:
        rest: (F2, 3) the faces without it.
        closed: mean correlation on it.
        pixel: how large one is at the object.
        edge: mean length of the surface's edges.
    """

    def __init__(self, looked: Looked, lid: Bool[Tensor, " F"], pushed: Float[Tensor, "V 3"]) -> None:
        vertices, faces, edges = looked.vertices, looked.faces, looked.topology.edges.long()
        self._lid_faces = faces[lid]
        self.rest, self.pixel, self.edge = faces[~lid], pixel_size(looked.photos), mean_edge(vertices, edges)
        up = self._up = normalize(area_normals(vertices, self._lid_faces).sum(dim=0), dim=0)
        self.closed = float(looked.score[faces[lid].unique()].nanmean())
        self._photos, self._vertices, self._own = looked.photos, vertices, self.rest.unique()
        normals = averaged(vertex_normals(vertices, faces), edges, _SMOOTH)
        self._normals, self._below = normals[self._own], normals @ up < -_LEVEL
        self._elsewhere = _elsewhere(vertices, edges, faces[lid].unique(), pushed, normals @ up)
        self._lid = [((hit >= 0) & lid[hit.clamp_min(0)]).float()[None, None] for _, hit in looked.hits]
        self._behind = [first_hits(photo, vertices, self.rest)[0][None, None] for photo in looked.photos]

    def walls(self, thickness: float, floor: float) -> _Walls:
        """So thick ones around what is under the lid, with what is beside it, where that is level and not on walls."""
        vertices, rest, up, beside = self._elsewhere, self.rest, self._up, _BESIDE * self.pixel
        lid = self._lid_faces[self._level(self._lid_faces, up)]
        away = _distance(vertices[rest].mean(dim=1), vertices, lid)
        around = self._level(rest, up) & (away <= thickness + beside)
        sides, above = rest[~around], torch.cat([lid, rest[around & (away <= beside)]])
        below = vertices[above].mean(dim=1) - 2 * thickness * up
        on_walls = _distance(below, vertices, sides) <= thickness
        rim = torch.cat([rest[around & (away > beside)], above[on_walls]])
        bottom = self._below[sides].all(dim=1)
        return _Walls(vertices, above[~on_walls], rim, sides[bottom], sides[~bottom], thickness, floor)

    def _level(self, faces: Int64[Tensor, "F 3"], up: Float[Tensor, " 3"]) -> Bool[Tensor, " F"]:
        """Which faces look up as a lid does."""
        return normalize(area_normals(self._vertices, faces), dim=1) @ up > _LEVEL

    def agreed(self, pixels: int) -> float:
        """Mean correlation on walls so thick, by how many photos see each place; 0 where too little is known."""
        return self._agreed(pixels * self.pixel, self._vertices, torch.ones_like(self._own, dtype=torch.bool))

    def floor_agreed(self, pixels: int) -> float:
        """The same on a bottom so thick."""
        return self._agreed(pixels * self.pixel, self._elsewhere, self._below[self._own])

    def _agreed(self, thickness: float, vertices: Float[Tensor, "V 3"], some: Bool[Tensor, " O"]) -> float:
        places = vertices[self._own] - thickness * self._normals
        some = some & (_distance(places, vertices, self.rest) >= _ALONE * thickness)
        places, normals = places[some], -self._normals[some]
        seen = torch.stack([self._seen(number, places) for number in range(len(self._photos))])
        views = seen.sum(dim=0)
        asked = views >= 2
        if not bool(asked.any()):
            return 0.0
        score = agreement(self._photos, self._lid, places[asked], normals[asked], seen[:, asked], self.pixel, fewest=2)
        weight = torch.where(score.isnan(), 0, views[asked]).float()
        known = int((weight > 0).sum())
        if known < max(_FEWEST, _KNOWN * len(score)):
            return 0.0
        return float((weight * score.nan_to_num()).sum() / weight.sum())

    def _seen(self, number: int, places: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which places a photo sees through the lid, before it sees the outer side of the walls from within."""
        photo = self._photos[number]
        place, z = photo.project(places)
        through, behind = (
            photo.look_up(plane, place[None], "nearest")[0, 0] for plane in (self._lid[number], self._behind[number])
        )
        return (through > 0.5) & ((behind == 0) | (z <= behind + 0.5 * self.pixel))
