"""Where vertices belong, by where masks have their outlines, to a small fraction of a pixel.

A mask says where its outline is: along a line across it alpha adds up to how far the object reaches, and what the
surface covers to how far that does. Each point of a surface's outline, in each photo, so says how far the two vertices
beside it are to move along their normals: a linear equation. There are several for each vertex, and least squares takes
all of them at once. A step of the optimizer sees one photo, and is done a quarter of a pixel inside, where what its
noise moves is as large as what it mends.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.sparse import coo_array, csc_array, diags_array, identity
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from etsplat.data.dataset import Dataset
from etsplat.data.photos import Photo, first_hits
from etsplat.data.pictures import as_float
from etsplat.geometry.laplacians import laplacian, solver
from etsplat.geometry.measures import vertex_normals
from etsplat.geometry.topology import MeshTopology

_ROUNDS = 2
"""Times that outlines are measured, each with what the one before has moved."""

_ALONG = (1 / 6, 1 / 2, 5 / 6)
"""Where on an edge outlines are measured."""

_REACH, _STEP = 2.0, 0.25
"""Pixels on either side of an outline that are looked at, and between two looks."""

_FINER = 2
"""Samples along either side of a pixel, by which the surface's own outline is drawn."""

_FULL, _EMPTY = 0.9, 0.1
"""Alpha at either end of the line across a mask's outline; otherwise there is no outline, or another one beside it."""

_BESIDE = 1.0
"""Pixels to either side, where the surface has to be seen, and nothing behind it."""

_ACROSS = 0.6
"""Sine of the angle to the line of sight, below which a normal hardly moves an outline."""

_DOUBTED = 0.5
"""Pixels from which on an outline is trusted less than half: Cauchy's weights."""

_ROUGH, _DEVIATION = 0.3, 1.48
"""Pixels that masks may disagree by, as the standard deviation of what is left over: rougher ones say less than the
steps have found. And that deviation as a multiple of the median of what is left over."""

_SMOOTH, _STILL = 0.3, 0.3
"""Weights, beside that of a measured pixel, of the differences of how far neighbours move, and of how far all do."""

Outlines = Callable[[Float[Tensor, "V 3"], MeshTopology], Float[Tensor, "V 3"]]
"""Of vertices and how they hang together, on the CPU, where they belong."""


class _Surface(NamedTuple):
    """A surface, and what of it does not depend on the photo.

    Attributes:
        vertices: (V, 3).
        normals: (V, 3).
        faces: (F, 3).
        across: (F, 3) their normals, twice their areas long.
        edges: (E, 2) between two faces.
        sides: (E, 2) these faces.
    """

    vertices: Float[Tensor, "V 3"]
    normals: Float[Tensor, "V 3"]
    faces: Int64[Tensor, "F 3"]
    across: Float[Tensor, "F 3"]
    edges: Int64[Tensor, "E 2"]
    sides: Int64[Tensor, "E 2"]

    @staticmethod
    def of(vertices: Tensor, topology: MeshTopology) -> "_Surface":
        faces = topology.faces
        a, b, c = vertices[faces].unbind(1)
        inner = topology.edge_face_counts == 2
        sides = topology.edge_faces[topology.edge_face_offsets[:-1][inner, None] + torch.arange(2)]
        normals = vertex_normals(vertices, faces)
        return _Surface(vertices, normals, faces, torch.linalg.cross(b - a, c - a), topology.edges[inner], sides)


class _Points(NamedTuple):
    """Points on edges, as a photo has them.

    Attributes:
        place: (N, 2) pixels.
        out: (N, 2) which way is out, across the edge.
        speed: (N,) pixels for each unit that the edge moves along normals.
        depth: (N,).
    """

    place: Float[Tensor, "N 2"]
    out: Float[Tensor, "N 2"]
    speed: Float[Tensor, " N"]
    depth: Float[Tensor, " N"]


class _Measured(NamedTuple):
    """What photos say of outlines: M equations shares[m] . moved[ends[m]] = pixels[m], moved along normals.

    Attributes:
        ends: (M, 2) the vertices on either side.
        shares: (M, 2) pixels for each unit that these move.
        pixels: (M,) how far outside of the surface's outline that of the mask is.
    """

    ends: Int64[Tensor, "M 2"]
    shares: Float[Tensor, "M 2"]
    pixels: Float[Tensor, " M"]


def outlines(dataset: Dataset) -> Outlines:
    """Where vertices of a surface belong by the masks of the training views, as a function of it.

    What no outline shows goes along with what is beside it. Without masks, all stay.

    Args:
        dataset: photos with alpha around an object in the unit ball.
    """

    @torch.no_grad()
    def fitted(vertices: Tensor, topology: MeshTopology) -> Tensor:
        for _ in range(_ROUNDS):
            surface = _Surface.of(vertices, topology)
            found = [_measured(photo, surface) for photo in _with_masks(dataset)]
            whole = _Measured(*(torch.cat(each) for each in zip(*found, strict=True))) if found else None
            if whole is None or len(whole.pixels) == 0:
                return vertices
            vertices = vertices + _moved(whole, topology)[:, None].to(vertices) * surface.normals
        return vertices

    return fitted


def _with_masks(dataset: Dataset) -> Iterator[Photo]:
    """Alpha of the training views, one after the other; it is not a number where pixels do not count."""
    for index in dataset.train:
        picture = dataset.images.picture(index)
        if picture.pixels.shape[-1] < 4:
            continue
        alpha = as_float(picture.pixels[..., 3])
        if picture.mask is not None:
            alpha = torch.where(picture.mask >= 128, alpha, torch.nan)
        yield Photo.of(dataset, index, alpha[None, None].contiguous())


def _measured(photo: Photo, surface: _Surface) -> _Measured:
    """Of one photo, whose pixels are alpha alone."""
    edges = _outline_edges(photo, surface)
    along = torch.tensor(_ALONG, dtype=surface.vertices.dtype)
    weights = torch.stack([1 - along, along], dim=1).repeat(len(edges), 1)
    ends = edges.repeat_interleave(len(along), dim=0)
    points, focal = _projected(photo, surface, ends, weights), photo.K[0, 0]
    depth, covered = _drawn(photo, surface)
    seen = _at_rim(depth, points, focal) & (points.speed > _ACROSS * focal / points.depth)
    offsets = torch.arange(-_REACH + 0.5 * _STEP, _REACH, _STEP)
    height, width = photo.pixels.shape[2:]
    line = points.place[:, None] + offsets[:, None] * points.out[:, None]
    line = 2 * line / torch.tensor([width, height]) - 1
    alpha, own = (photo.look_up(plane, line)[0] for plane in (photo.pixels, covered))
    for profile in (alpha, own):
        seen &= (profile[:, 0] > _FULL) & (profile[:, -1] < _EMPTY)
    pixels = _STEP * (alpha - own).sum(dim=1)
    seen &= pixels.isfinite()
    return _Measured(ends[seen], (weights * points.speed[:, None])[seen], pixels[seen])


def _drawn(photo: Photo, surface: _Surface) -> tuple[Tensor, Tensor]:
    """(H, W) depth of the surface in a photo, 0 where there is none, and (1, 1, H, W) how much of a pixel it covers."""
    height, width = photo.pixels.shape[2:]
    fine = torch.zeros(1).expand(1, 1, _FINER * height, _FINER * width)
    K = torch.tensor([_FINER, _FINER, 1.0])[:, None] * photo.K
    depth, _ = first_hits(replace(photo, pixels=fine, K=K), surface.vertices, surface.faces)
    return depth[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER], avg_pool2d((depth > 0).float()[None, None], _FINER)


def _outline_edges(photo: Photo, surface: _Surface) -> Int64[Tensor, "N 2"]:
    """Between a face that looks at the camera and one that does not."""
    corner = surface.vertices[surface.faces[:, 0]]
    facing = ((corner - photo.center) * surface.across).sum(dim=1) < 0
    one, other = facing[surface.sides].unbind(dim=1)
    return surface.edges[one != other]


def _projected(photo: Photo, surface: _Surface, ends: Tensor, weights: Tensor) -> _Points:
    """(N, 2) ends of edges with their weights, as a photo has the points between."""
    rotation, focal = photo.viewmat[:3, :3], torch.stack([photo.K[0, 0], photo.K[1, 1]])
    corners = surface.vertices[ends] @ rotation.T + photo.viewmat[:3, 3]
    point = (weights[:, :, None] * corners).sum(dim=1)
    normal = normalize((weights[:, :, None] * surface.normals[ends]).sum(dim=1), dim=1) @ rotation.T
    z = point[:, 2]
    place = focal * point[:, :2] / z[:, None] + photo.K[:2, 2]
    moved = focal * (normal[:, :2] - point[:, :2] / z[:, None] * normal[:, 2:]) / z[:, None]
    first, second = (focal * corners[:, end, :2] / corners[:, end, 2:] for end in range(2))
    right, down = normalize(second - first, dim=1).unbind(dim=1)
    across = torch.stack([down, -right], dim=1)
    speed = (across * moved).sum(dim=1)
    return _Points(place, across * torch.where(speed < 0, -1.0, 1.0)[:, None], speed.abs(), z)


def _at_rim(depth: Tensor, points: _Points, focal: Tensor) -> Tensor:
    """(N,) whether the surface is seen on one side of a point, at its depth, and nothing on the other."""
    height, width = depth.shape
    size = torch.tensor([width, height])
    within, beyond = ((points.place + side * _BESIDE * points.out).floor().long() for side in (-1, 1))
    margin = round(_REACH)
    inside = ((within >= margin) & (within < size - margin)).all(dim=1) & (points.depth > 0)
    within, beyond = (torch.minimum(each.clamp_min(0), size - 1) for each in (within, beyond))
    # By so much depths differ that far within the outline of a ball as large as the object; what differs by more is
    # another part, in front or behind.
    hit = depth[within[:, 1], within[:, 0]]
    same = (hit - points.depth).abs() < (4 * _BESIDE * points.depth / focal).sqrt()
    return inside & (hit > 0) & same & (depth[beyond[:, 1], beyond[:, 0]] == 0)


def _moved(found: _Measured, topology: MeshTopology) -> Float[Tensor, " V"]:
    """How far each vertex moves along its normal, in units of the scene, float64; nowhere where masks are rough."""
    V, M = topology.num_vertices, len(found.pixels)
    unit = 1 / float(found.shares.sum(dim=1).median())  # so that unknowns are pixels, as weights are
    shares, rows = (unit * found.shares.double()).reshape(-1).numpy(), np.arange(M).repeat(2)
    matrix = coo_array((shares, (rows, found.ends.reshape(-1).numpy())), shape=(M, V)).tocsr()
    pixels = found.pixels.double().numpy()
    trusted = 1 / (1 + (pixels / _DOUBTED) ** 2)
    normal = matrix.T @ diags_array(trusted) @ matrix
    normal = normal + _SMOOTH * laplacian(topology.edges, V) + _STILL * identity(V)
    moved = solver(csc_array(normal))(matrix.T @ (trusted * pixels))
    noise = _DEVIATION * np.median(np.abs(pixels - matrix @ moved))
    return torch.from_numpy(unit * moved * (noise <= _ROUGH))
