"""Sides of a hull of which photos say nothing: over a flat side it stands like a tent.

Where photos show one colour, the silhouettes need the side's edges alone: each line of sight that touches the tent
touches an edge too, where the hull is sharper. So of the vertices that silhouettes need, the sharpest stay; the others
are drawn to the smallest surface between those that stay, and inwards only. So is what no photo sees, such as the
bottom of what stands on a table, under which the hull is a cone: all of it, as far as it hides nothing that is seen.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from etsplat.data.agreement import AGREED, looked_at
from etsplat.data.dataset import Dataset
from etsplat.data.photos import Hit, Photo, first_hits, pixel_size, reduced
from etsplat.data.silhouettes import Silhouette
from etsplat.geometry.films import held, tight_film
from etsplat.geometry.measures import mean_edge, vertex_normals

_OUTLINE = 1.5
"""Pixels from the outline, within which a vertex touches it."""

_ALIKE = 0.5
"""Cosine of the angle between outlines that run along each other."""

_ROUND = 3
"""Rounds in which places are averaged with their neighbours', to see where the hull is sharp."""

_BESIDE = 2
"""So many neighbours away patches may show a side's edge, at which photos agree if the hull is the surface there."""

_REACH = 0.75
"""Mean lengths of edges, to which a vertex holds an outline on either side."""

_LEAST = 0.02
"""Share of the vertices that plain sides have at least: for less a hull is better left as it is."""

_HIDES = 2.0
"""Pixels in front of what was seen before, from which on a vertex hides it."""

_SOLVES = 8
"""Rounds in which vertices are found that have to stay after all."""


@torch.no_grad()
def with_flat_sides(
    dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Where the vertices of a hull belong, whose plain sides are flat.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        vertices: (V, 3) of the hull.
        faces: (F, 3) of it.
    """
    dataset = reduced(dataset)
    looked = looked_at(dataset, vertices, faces)
    if looked is None:
        return vertices
    photos, _, _, topology, hits, seen, score = looked
    edges, sees = topology.edges.long(), seen.sum(dim=0)
    unseen = sees == 0
    free = _silent(unseen | (score.isnan() & (sees >= 2)), score, edges)
    free[edges[topology.edge_face_counts == 1].reshape(-1)] = False  # borders, where lids were
    if float(free.float().mean()) < _LEAST:
        return vertices
    normals = vertex_normals(vertices, faces)
    views = [Silhouette(dataset, index) for index in dataset.train]
    free &= unseen | ~_needed(photos, views, vertices, normals, edges, free)
    free = held(free, edges)
    return _drawn_flat(photos, hits, vertices, faces, edges, normals, free, unseen)


def _silent(nothing: Bool[Tensor, " V"], score: Float[Tensor, " V"], edges: Int64[Tensor, "E 2"]) -> Bool[Tensor, " V"]:
    """Where photos say nothing, and beside that where they do not agree."""
    silent = nothing.clone()
    source, target = torch.cat([edges, edges.flip(1)]).T
    for _ in range(_BESIDE):
        beside = torch.zeros(len(silent)).index_add(0, target, silent[source].float()) > 0
        silent |= beside & ~(score >= AGREED)
    return silent


def _needed(
    photos: list[Photo], views: list[Silhouette], vertices: Tensor, normals: Tensor, edges: Tensor, free: Tensor
) -> Bool[Tensor, " V"]:
    """The vertices that outlines need, the sharpest first, and those that touch none."""
    length = mean_edge(vertices, edges)
    outlines = [_Outline(photo, view, vertices) for photo, view in zip(photos, views, strict=True)]
    sharpness = ((vertices - _between(vertices, edges, _ROUND)) * normals).sum(dim=1)
    reach = _REACH * length / pixel_size(photos)
    touched = torch.stack([outline.touched for outline in outlines])
    for outline in outlines:
        outline.cover((outline.touched & ~free).nonzero()[:, 0].numpy(), reach)
    needed = ~free | ~touched.any(dim=0)
    asked = (free & ~needed).nonzero()[:, 0]
    for vertex in asked[torch.argsort(sharpness[asked], descending=True, stable=True)].tolist():
        at = [outlines[number] for number in touched[:, vertex].nonzero()[:, 0].tolist()]
        if any(outline.bare(vertex) for outline in at):
            needed[vertex] = True
            for outline in at:
                outline.cover(np.array([vertex]), reach)
    return needed


class _Outline:
    """Where a view's outline is held by vertices."""

    def __init__(self, photo: Photo, view: Silhouette, vertices: Tensor) -> None:
        places, _ = photo.project(vertices)
        self.touched = photo.look_up(view.distance, places[None])[0, 0].abs() <= _OUTLINE
        self._at = photo.in_pixels(places).numpy()
        self._outline = view.inside & (view.distance[0, 0].numpy() < 1)
        self._bare = self._outline.copy()
        slope = torch.stack(torch.gradient(view.distance[0, 0]))
        self._across = torch.nn.functional.normalize(slope, dim=0).numpy()

    def _near(self, vertices: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the pixels that are near some vertices and run along the outline as it does there."""
        x, y = self._at[vertices].astype(np.float64).T
        height, width = self._bare.shape
        span = np.arange(int(2 * reach) + 2)
        rows, columns = (np.floor(at - reach).astype(np.int64)[:, None] + span for at in (y, x))
        down, right = rows + 0.5 - y[:, None], columns + 0.5 - x[:, None]
        near = down[:, :, None] ** 2 + right[:, None] ** 2 <= reach**2
        near &= ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None]
        vertex, a, b = near.nonzero()
        row, column = rows[vertex, a], columns[vertex, b]
        here = [np.clip(at.astype(np.int64), 0, size - 1)[vertex] for at, size in ((y, height), (x, width))]
        alike = sum(slope[row, column] * slope[here[0], here[1]] for slope in self._across) > _ALIKE
        return row[alike], column[alike]

    def bare(self, vertex: int) -> bool:
        """Whether no vertex that stays holds the outline here."""
        near = self._near(np.array([vertex]), _OUTLINE)
        outline = self._outline[near]
        return bool(2 * (self._bare[near] & outline).sum() > outline.sum())

    def cover(self, vertices: np.ndarray, reach: float) -> None:
        """These stay."""
        self._bare[self._near(vertices, reach)] = False


def _drawn_flat(
    photos: list[Photo],
    hits: list[Hit],
    vertices: Tensor,
    faces: Tensor,
    edges: Tensor,
    normals: Tensor,
    free: Tensor,
    unseen: Tensor,
) -> Float[Tensor, "V 3"]:
    """The smallest surface; free vertices stay that outlines miss, that would move outwards, or hide others."""
    free, moved, slack = free.clone(), vertices, _HIDES * pixel_size(photos)
    for _ in range(_SOLVES):
        if not bool(free.any()):
            return vertices
        moved = tight_film(vertices, edges, free)
        stay = free & (((moved - vertices) * normals).sum(dim=1) > 0)
        for photo, (depth, before) in zip(photos, hits, strict=True):
            nearest, after = first_hits(photo, moved, faces)
            missed = (before >= 0) & (after < 0) & (photo.pixels[0, 3] > 0.95)
            hides = (before >= 0) & (after >= 0) & (nearest < depth - slack)
            stay[faces[before[missed]].reshape(-1)] = True
            hiding = faces[after[hides]].reshape(-1)
            stay[hiding[unseen[hiding]]] = True
        stay &= free
        if not bool(stay.any()):
            break
        free &= ~stay
    return moved


def _between(vertices: Tensor, edges: Tensor, rounds: int) -> Float[Tensor, "V 3"]:
    """Places averaged with their neighbours' so many times."""
    source, target = torch.cat([edges, edges.flip(1)]).T
    count = 1 + target.bincount(minlength=len(vertices))[:, None]
    for _ in range(rounds):
        vertices = vertices.index_add(0, target, vertices[source]) / count
    return vertices
