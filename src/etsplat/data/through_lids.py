"""What photos see through a lid of a hull, if what is below it is a hollow with walls that are so thick."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.data.agreement import SMOOTH, Looked, agreement, averaged, first_hits, pixel_size
from etsplat.data.same_colors import colors_at, sameness
from etsplat.geometry.distance import closest_points
from etsplat.geometry.measures import area_normals, mean_edge, vertex_normals
from etsplat.geometry.topology import connected

LEVEL = 0.7
"""Cosine of the angle between a lid's mean normal and those of its own faces and of the rim's, at least."""

_ALONE = 0.9
"""A place is on a wall if nothing else of the surface is nearer than this, in units of the thickness."""

_KNOWN, _FEWEST = 0.2, 64
"""Of the places on walls that two photos see, so many have texture, and so many there are: else it may be chance."""


class ThroughLid:
    """What photos see through a lid.

    Attributes:
        vertices: (V, 3) of the hull.
        lid: (L, 3) its faces over what may be a hollow.
        rest: (R, 3) the faces without it.
        elsewhere: (V, 3) vertices, where they were pushed in if that is not the lid, nor looks up as it does.
        up: (3,) where the lid looks.
        pixel: how large one is at the object.
        edge: mean length of the surface's edges.
    """

    def __init__(self, looked: Looked, lid: Bool[Tensor, " F"], pushed: Float[Tensor, "V 3"]) -> None:
        vertices, faces, edges = looked.vertices, looked.faces, looked.topology.edges.long()
        self.vertices, self.lid, self.rest = vertices, faces[lid], faces[~lid]
        self.pixel, self.edge = pixel_size(looked.photos), mean_edge(vertices, edges)
        self.up = normalize(area_normals(vertices, self.lid).sum(dim=0), dim=0)
        self._looked, self._photos, self._own = looked, looked.photos, self.rest.unique()
        normals = averaged(vertex_normals(vertices, faces), edges, SMOOTH)
        self._normals, self._below = normals[self._own], normals @ self.up < -LEVEL
        self.elsewhere = _elsewhere(vertices, edges, self.lid.unique(), pushed, normals @ self.up)
        self._of_lid, self._within = lid, torch.full((len(faces),), -torch.inf)
        self._within[lid] = distance_from(vertices[self.lid].mean(dim=1), vertices, self.rest)
        self._behind = [first_hits(photo, vertices, self.rest)[0][None, None] for photo in looked.photos]

    def level(self, faces: Int64[Tensor, "F 3"]) -> Bool[Tensor, " F"]:
        """Which faces look up as the lid does."""
        return normalize(area_normals(self.vertices, faces), dim=1) @ self.up > LEVEL

    def bottom(self, faces: Int64[Tensor, "F 3"]) -> Bool[Tensor, " F"]:
        """Which faces look down where the lid looks up."""
        return self._below[faces].all(dim=1)

    def closed(self) -> float:
        """Mean correlation on the lid itself; NaN where nothing is known."""
        return float(self._looked.score[self.lid.unique()].nanmean())

    def agreed(self, pixels: int) -> float:
        """Mean correlation on walls so thick, by how many photos see each place; 0 where too little is known."""
        return self._agreed(pixels * self.pixel, self.vertices, torch.ones_like(self._own, dtype=torch.bool))

    def floor_agreed(self, pixels: int) -> float:
        """The same on a bottom so thick."""
        return self._agreed(pixels * self.pixel, self.elsewhere, self._below[self._own])

    def closed_sameness(self, rim: int) -> float:
        """How far each place on the lid itself has one colour, but for so much along its border."""
        own = self.lid[self._within[self._of_lid] > rim * self.pixel].unique()
        return sameness(colors_at(self._photos, self.vertices[own]), self._looked.seen[:, own])

    def sameness(self, pixels: int, floor: int, rim: int) -> float:
        """How far each place on walls so thick has one colour, with a bottom so thick; 0 where too little is seen.

        So much of the lid along its border is left out: it may be the rim, which hides what is behind.
        """
        thickness = torch.where(self._below[self._own], float(floor), float(pixels)) * self.pixel
        vertices = torch.where(self._below[:, None], self.elsewhere, self.vertices)
        places = vertices[self._own] - thickness[:, None] * self._normals
        places = places[distance_from(places, vertices, self.rest) >= _ALONE * thickness]
        seen = self._seen(places, self._masks(rim * self.pixel))
        enough = seen.sum(dim=0) >= 2
        if int(enough.sum()) < _FEWEST:
            return 0.0
        return sameness(colors_at(self._photos, places[enough]), seen[:, enough])

    def _agreed(self, thickness: float, vertices: Float[Tensor, "V 3"], some: Bool[Tensor, " O"]) -> float:
        places = vertices[self._own] - thickness * self._normals
        some = some & (distance_from(places, vertices, self.rest) >= _ALONE * thickness)
        places, normals, masks = places[some], -self._normals[some], self._masks(-torch.inf)
        seen = self._seen(places, masks)
        views = seen.sum(dim=0)
        asked = views >= 2
        if not bool(asked.any()):
            return 0.0
        score = agreement(self._photos, masks, places[asked], normals[asked], seen[:, asked], self.pixel, fewest=2)
        weight = torch.where(score.isnan(), 0, views[asked]).float()
        known = int((weight > 0).sum())
        if known < max(_FEWEST, _KNOWN * len(score)):
            return 0.0
        return float((weight * score.nan_to_num()).sum() / weight.sum())

    def _masks(self, within: float) -> list[Float[Tensor, "1 1 H W"]]:
        """Where each photo sees the lid, farther from its border than this."""
        lid = self._within > within
        return [((hit >= 0) & lid[hit.clamp_min(0)]).float()[None, None] for _, hit in self._looked.hits]

    def _seen(self, places: Float[Tensor, "N 3"], masks: list[Tensor]) -> Bool[Tensor, "B N"]:
        """Which photos see which places through the lid, before they see the outer side of the walls from within."""
        seen = []
        for photo, mask, depth in zip(self._photos, masks, self._behind, strict=True):
            place, z = photo.project(places)
            through, behind = (photo.look_up(plane, place[None], "nearest")[0, 0] for plane in (mask, depth))
            seen.append((through > 0.5) & ((behind == 0) | (z <= behind + 0.5 * self.pixel)))
        return torch.stack(seen)


def distance_from(
    points: Float[Tensor, "N 3"], vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> Float[Tensor, " N"]:
    """Of points from some faces; infinite if there are none."""
    if len(faces) == 0:
        return points.new_full((len(points),), torch.inf)
    return closest_points(points, vertices, faces)[0].sqrt().to(points)


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
    own = torch.isin(patch, patch[lid]) | (mean > LEVEL)[patch]
    return torch.where((moved & ~own)[:, None], pushed, vertices)
