"""Tangents at the corners of a mesh under a texture, as programs that read glTF derive them (MikkTSpace)."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.core.validation import check_indices, check_shape


def corner_tangents(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    normals: Float[Tensor, "V 3"],
    face_uvs: Float[Tensor, "F 3 2"],
) -> Float[Tensor, "F 3 4"]:
    """Unit vectors along which u grows, perpendicular to the normals, and on which side of them v falls.

    At a corner it is the mean over all faces with the same vertex, the same texture coordinates and the same
    orientation in the texture, each projected to the plane of the normal and weighted by its angle there: the rule of
    Mikkelsen, "Simulation of Wrinkled Surfaces Revisited" (2008), which glTF names.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        normals: (V, 3) unit vectors.
        face_uvs: (F, 3, 2), u to the right and v down, as in glTF.

    Returns:
        (F, 3, 4): the tangent t, and w of 1 or -1 so that v falls along w (n x t), which is up in the picture.

    Raises:
        ValueError: wrong shape or index.
    """
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    check_shape("normals", normals, (len(vertices), 3))
    check_shape("face_uvs", face_uvs, (len(faces), 3, 2))
    check_indices("faces", faces, len(vertices))
    points = vertices.detach().cpu().double()[faces.cpu().long()]
    normal = normals.detach().cpu().double()[faces.cpu().long()]
    uvs = face_uvs.detach().cpu()
    sides, u, up = points[:, 1:] - points[:, :1], *_steps(uvs)
    mirrored = u[:, 0] * up[:, 1] < u[:, 1] * up[:, 0]
    along = up[:, 1:] * sides[:, 0] - up[:, :1] * sides[:, 1]
    along = torch.where(mirrored[:, None], -along, along)[:, None].expand_as(points)
    tangents = _flat(along, normal) * _angles(points, normal)[..., None]
    group, count = _groups(faces, uvs, mirrored)
    summed = torch.zeros(count, 3, dtype=torch.float64).index_add_(0, group, tangents.reshape(-1, 3))
    tangents = _flat(summed[group].view_as(points), normal)
    missing = tangents.square().sum(dim=-1) < 0.5
    tangents[missing] = _some_perpendicular(normal[missing])
    signs = torch.where(mirrored, -1.0, 1.0).double()[:, None, None].expand(len(points), 3, 1)
    return torch.cat([tangents, signs], dim=-1).to(vertices)


def _steps(uvs: Tensor) -> tuple[Tensor, Tensor]:
    """(F, 2) each: how u and 1 - v change from the first corner to the others."""
    steps = uvs.double()[:, 1:] - uvs.double()[:, :1]
    return steps[..., 0], -steps[..., 1]


def _flat(vectors: Tensor, normals: Tensor) -> Tensor:
    """Unit vectors in the planes of normals; zero where there are none."""
    return normalize(vectors - (vectors * normals).sum(dim=-1, keepdim=True) * normals, dim=-1, eps=1e-30)


def _angles(points: Tensor, normals: Tensor) -> Tensor:
    """(F, 3) of each face at its corners, seen along the normals there."""
    onward = _flat(points.roll(-1, dims=1) - points, normals)
    back = _flat(points.roll(1, dims=1) - points, normals)
    return (onward * back).sum(dim=-1).clamp(-1, 1).acos()


def _groups(faces: Tensor, uvs: Tensor, mirrored: Tensor) -> tuple[Tensor, int]:
    """(3F,) numbers of groups of corners that have a tangent in common, and how many groups there are."""
    bits = np.ascontiguousarray(uvs.float().numpy()).view(np.int32).reshape(-1, 2)
    keys = np.column_stack([faces.cpu().numpy().reshape(-1), bits, np.repeat(mirrored.numpy(), 3)])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    return torch.from_numpy(group.reshape(-1)), int(group.max()) + 1


def _some_perpendicular(normals: Tensor) -> Tensor:
    axis = torch.nn.functional.one_hot(normals.abs().argmin(dim=-1), 3).to(normals)
    return _flat(axis, normals)
