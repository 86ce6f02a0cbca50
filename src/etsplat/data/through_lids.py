"""What photos see through a lid of a hull, if what is below it is a hollow with walls that are so thick."""

import copy
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.data.agreement import SMOOTH, Looked, agreement, averaged
from etsplat.data.photos import PixelsOf, first_hits, pixel_size
from etsplat.data.same_colors import colors_at, sameness
from etsplat.geometry.distance import ClosestPoints
from etsplat.geometry.measures import area_normals, mean_edge, vertex_normals
from etsplat.geometry.topology import connected

LEVEL = 0.7
"""Cosine of the angle between a lid's mean normal and those of its own faces and of the rim's, at least."""

_ALONE = 0.9
"""A place is on a wall if nothing else of the surface is nearer than this, in units of the thickness."""

_KNOWN, _FEWEST = 0.2, 64
"""Of the places on walls that two photos see, so many have texture, and so many there are: else it may be chance."""


class _Seen(NamedTuple):
    """Places on walls that are nearest there, each seen through a lid by two photos at least.

    Attributes:
        own: (N,) of which vertices.
        places: (N, 3).
        seen: (B, N) by which photos.
        within: (B, N) how far from the lid's border each photo looks through it; 0 beside it.
    """

    own: Int64[Tensor, " N"]
    places: Float[Tensor, "N 3"]
    seen: Bool[Tensor, "B N"]
    within: Float[Tensor, "B N"]


class Surface:
    """Some faces with vertices (V, 3), and how far points are from them."""

    def __init__(self, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> None:
        self.vertices = vertices
        self._closest = ClosestPoints(vertices, faces) if len(faces) > 0 else None

    def distance(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Infinite if there are no faces."""
        if self._closest is None:
            return points.new_full((len(points),), torch.inf)
        return self._closest(points)[0].sqrt().to(points)


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
        bottom_pushed = torch.where(self._below[:, None], self.elsewhere, vertices)
        placed = (Surface(each, self.rest) for each in (vertices, self.elsewhere, bottom_pushed))
        self._hull, self._pushed, self._bottom_pushed = placed
        self._within = self._hull.distance(vertices[self.lid].mean(dim=1))
        of_faces = torch.zeros(len(faces) + 1)  # the last where there is none
        of_faces[:-1][lid] = self._within
        of_pixels = [of_faces[hit] for _, hit in looked.hits]
        self._masks = [(within > 0).float()[None, None] for within in of_pixels]
        self._pixels = PixelsOf(looked.photos)
        self._of_pixels = self._pixels.together(of_pixels)
        self._behind = self._pixels.together([first_hits(photo, vertices, self.rest)[0] for photo in looked.photos])
        self._colors = dict[tuple[int, int], tuple[_Seen, Tensor]]()

    def thinned(self, every: int) -> "ThroughLid":
        """The same, asked of one in so many of the places."""
        found = copy.copy(self)
        found._own, found._normals, found._colors = self._own[::every], self._normals[::every], {}
        return found

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
        return self._agreed(pixels, self._hull)

    def floor_agreed(self, pixels: int) -> float:
        """The same on a bottom so thick."""
        return self._agreed(pixels, self._pushed, self._below[self._own])

    def closed_sameness(self, rim: int) -> float:
        """How far each place on the lid itself has one colour, but for so much along its border."""
        own = self.lid[self._within > rim * self.pixel].unique()
        return sameness(colors_at(self._photos, self.vertices[own]), self._looked.seen[:, own])

    def sameness(self, pixels: int, floor: int, rim: int) -> float:
        """How far each place on walls so thick has one colour, with a bottom so thick; 0 where too little is seen.

        So much of the lid along its border is left out: it may be the rim, which hides what is behind.
        """
        found, colors = self._colors_of(pixels, floor)
        seen = found.seen & (found.within > rim * self.pixel)
        enough = seen.sum(dim=0) >= 2
        return sameness(colors[:, enough], seen[:, enough]) if int(enough.sum()) >= _FEWEST else 0.0

    def _colors_of(self, pixels: int, floor: int) -> tuple[_Seen, Float[Tensor, "B N 3"]]:
        """Places on walls and bottom so thick, and their colours: asked of again with other rims."""
        if (pixels, floor) not in self._colors:
            thickness = torch.where(self._below[self._own], float(floor), float(pixels)) * self.pixel
            found = self._seen(thickness, self._bottom_pushed)
            self._colors[pixels, floor] = found, colors_at(self._photos, found.places)
        return self._colors[pixels, floor]

    def _agreed(self, pixels: int, surface: Surface, some: Bool[Tensor, " O"] | None = None) -> float:
        own, places, seen, _ = self._seen(torch.full((len(self._own),), pixels * self.pixel), surface, some)
        if len(own) == 0:
            return 0.0
        score = agreement(self._photos, self._masks, places, -self._normals[own], seen, self.pixel, fewest=2)
        weight = torch.where(score.isnan(), 0, seen.sum(dim=0)).float()
        known = int((weight > 0).sum())
        if known < max(_FEWEST, _KNOWN * len(score)):
            return 0.0
        return float((weight * score.nan_to_num()).sum() / weight.sum())

    def _seen(self, thickness: Float[Tensor, " O"], surface: Surface, some: Bool[Tensor, " O"] | None = None) -> _Seen:
        """Places so far within a surface that photos see through the lid, before its outer side from within."""
        own = torch.arange(len(self._own)) if some is None else some.nonzero()[:, 0]
        places = surface.vertices[self._own[own]] - thickness[own, None] * self._normals[own]
        shown, z = self._pixels.show(places)
        within, behind = self._of_pixels[shown], self._behind[shown]
        by = (within > 0) & ((behind == 0) | (z <= behind + 0.5 * self.pixel))
        asked = (by.sum(dim=0) >= 2).nonzero()[:, 0]
        alone = surface.distance(places[asked]) >= _ALONE * thickness[own[asked]]
        asked = asked[alone]
        return _Seen(own[asked], places[asked], by[:, asked], within[:, asked])


def distance_from(
    points: Float[Tensor, "N 3"], vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> Float[Tensor, " N"]:
    """Of points from some faces; infinite if there are none."""
    return Surface(vertices, faces).distance(points)


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
