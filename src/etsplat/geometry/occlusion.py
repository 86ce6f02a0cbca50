"""Ambient occlusion: how much of the light that comes from all around, equally, reaches points of a surface."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.core.cameras import Cameras
from etsplat.core.validation import check_indices, check_shape
from etsplat.ops.rasterize_opaque import rasterize_opaque

DIRECTIONS, WIDTH = 192, 1024
"""Directions of the light, and pixels across the pictures of the surface from each."""

_DISTANCE = 100.0  # of the eye, in radii: rays are parallel to half a degree
_MARGIN = 1.02
_STEEPEST = 8.0


@torch.no_grad()
def ambient_occlusion(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    *,
    directions: int = DIRECTIONS,
    width: int = WIDTH,
) -> Float[Tensor, " N"]:
    """The part of light from all around that reaches points, 1 where nothing is in its way.

    The surface is drawn from each direction w by the z-buffer; V(p, w) says whether p is what is seen there, as near as
    pixels tell. The result is sum V(p, w) max(0, n.w) / sum max(0, n.w).

    Args:
        vertices: (V, 3) finite.
        faces: (F, 3), at least one; seen from both sides.
        points: (N, 3) on the surface.
        normals: (N, 3) unit.
        directions: how many, all around.
        width: of the pictures in pixels. What is nearer together than about two of them does not shade each other.

    Raises:
        ValueError: wrong shape or index.
    """
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    check_indices("faces", faces, len(vertices))
    check_shape("points", points, ("N", 3))
    check_shape("normals", normals, (len(points), 3))
    middle = (vertices.amin(dim=0) + vertices.amax(dim=0)) / 2
    radius = float((vertices - middle).norm(dim=1).max().clamp_min(1e-30))
    shape, places = (vertices - middle) / radius, (points - middle) / radius
    pixel = 2 * _MARGIN / width
    K = torch.tensor([[_DISTANCE / pixel, 0, width / 2], [0, _DISTANCE / pixel, width / 2], [0, 0, 1]])[None].to(shape)
    seen, whole = places.new_zeros(len(places)), places.new_zeros(len(places))
    for rotation in _rotations(directions).to(shape):
        viewmat = torch.eye(4).to(shape)
        viewmat[:3, :3], viewmat[2, 3] = rotation, _DISTANCE
        drawn = rasterize_opaque(shape, cameras=Cameras(viewmat[None], K, width, width), faces=faces)
        toward = normalize(-_DISTANCE * rotation[2] - places, dim=1)
        cosine = (normals * toward).sum(dim=1).clamp_min(0)
        x, y, z = (places @ rotation.T + viewmat[:3, 3]).unbind(dim=1)
        column = (K[0, 0, 0] * x / z + width / 2).long().clamp(0, width - 1)
        row = (K[0, 1, 1] * y / z + width / 2).long().clamp(0, width - 1)
        steep = ((1 - cosine.square()).clamp_min(0).sqrt() / cosine.clamp_min(1e-6)).clamp_max(_STEEPEST)
        nearest = drawn.depth[0, row, column, 0] if drawn.depth is not None else z
        free = (drawn.alpha[0, row, column, 0] == 0) | (z <= nearest + pixel * (1 + steep))
        seen += cosine * free
        whole += cosine
    return torch.where(whole > 0, seen / whole.clamp_min(1e-12), 1.0)


def _rotations(count: int) -> Float[Tensor, "D 3 3"]:
    """Rows of cameras that look from points all around, spread evenly along a spiral, at the middle."""
    steps = torch.arange(count, dtype=torch.float64)
    height, angle = 1 - (2 * steps + 1) / count, math.pi * (3 - math.sqrt(5)) * steps
    across = (1 - height.square()).sqrt()
    forward = -torch.stack([across * angle.cos(), across * angle.sin(), height], dim=1)
    aside = torch.where(forward[:, 2:].abs() < 0.9, forward.new_tensor([0.0, 0, 1]), forward.new_tensor([1.0, 0, 0]))
    right = normalize(torch.linalg.cross(aside, forward), dim=1)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
