"""Thin parts of a mesh that are inside out: their front and back, which went through each other, change places."""

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from etsplat.geometry.measures import vertex_normals
from etsplat.geometry.piercings import overlapping_boxes, winding_numbers
from etsplat.geometry.topology import MeshTopology, connected

_BESIDE = 1e-3
"""How far from a vertex it is asked what is outside of it, in median edges."""

_WITNESSES = 3
"""So many vertices of what no crossing parts are asked; most of them are right."""

_THICK = 4.0
"""What is inside out was thinner than nothing once: through it are at most so many median edges."""


def inside_out(
    vertices: Float[Tensor, "V 3"], topology: MeshTopology, marked: Bool[Tensor, " F"]
) -> Bool[Tensor, " V"]:
    """Vertices just outside of which the mesh winds around space a negative number of times.

    What is connected without a marked face between is alike, so that a few of its vertices speak for all. A mesh most
    of which is inside out is one whose faces all look inwards: nothing is marked.

    Args:
        vertices: (V, 3) float64 on the CPU.
        topology: of the mesh, on the CPU.
        marked: (F,) faces that intersect others.
    """
    edges = topology.edges.long()
    beside = _BESIDE * _median_edge(vertices, topology)
    crossed = torch.zeros(len(vertices), dtype=torch.bool)
    crossed[topology.faces[marked].long().reshape(-1)] = True
    count, part = connected(edges[~crossed[edges].any(dim=1)], len(vertices))
    order = torch.argsort(part, stable=True)
    sizes = part.bincount(minlength=count)
    first = sizes.cumsum(0) - sizes
    places = torch.stack([(sizes - 1) * k // (_WITNESSES - 1) for k in range(_WITNESSES)], dim=1)
    asked, witness = order[(first[:, None] + places)].unique(return_inverse=True)
    outside = vertices[asked] + beside * vertex_normals(vertices, topology.faces)[asked]
    negative = (winding_numbers(outside, vertices, topology) < 0)[witness]
    found = (2 * negative.sum(dim=1) > _WITNESSES)[part]
    return found if 2 * int(found.sum()) < len(found) else torch.zeros_like(found)


def turned_out(
    vertices: Float[Tensor, "V 3"], topology: MeshTopology, wrong: Bool[Tensor, " V"]
) -> Float[Tensor, "V 3"]:
    """The mesh with those parts turned right: the surface stays where it is, as far as lines across them say.

    A part has one direction, across which it is thinnest by the normals of its faces. Along it each of its vertices
    goes through the part, to the face on the other side. One that has none there, as at a rim, stays.

    Args:
        vertices: (V, 3) float64 on the CPU.
        topology: of the mesh, on the CPU.
        wrong: (V,) which vertices are inside out, as of `inside_out`.
    """
    edges, faces = topology.edges.long(), topology.faces.long()
    count, part = connected(edges[wrong[edges].all(dim=1)], len(vertices))
    faces = faces[wrong[faces].any(dim=1)]
    a, b, c = vertices[faces].unbind(1)
    normals = torch.linalg.cross(b - a, c - a)
    squares = normals[:, :, None] * normals[:, None, :] / normals.norm(dim=1).clamp(min=1e-30)[:, None, None]
    owner = torch.where(wrong[faces], part[faces], -1).amax(dim=1)
    own = torch.unique(owner)
    tensors = torch.zeros(count, 3, 3).to(vertices).index_add_(0, owner, squares)
    across = torch.zeros(count, 3).to(vertices)
    across[own] = torch.linalg.eigh(tensors[own]).eigenvectors[:, :, 2]
    moving = wrong.nonzero()[:, 0]
    inwards = across[part[moving]]
    same = (inwards * vertex_normals(vertices, topology.faces)[moving]).sum(dim=1) >= 0
    inwards = torch.where(same[:, None], inwards, -inwards)
    way = _way_through(moving, vertices, inwards, faces, _THICK * _median_edge(vertices, topology))
    turned = vertices.clone()
    turned[moving] += torch.where(way.isfinite(), way, 0.0)[:, None] * inwards
    return turned


def _way_through(
    moving: Int64[Tensor, " N"],
    vertices: Float[Tensor, "V 3"],
    directions: Float[Tensor, "N 3"],
    faces: Int64[Tensor, "F 3"],
    thick: float,
) -> Float[Tensor, " N"]:
    """From each vertex along its direction to the nearest face that looks against it; infinite where none is near."""
    starts, count = vertices[moving], len(moving)
    lines = torch.stack([starts, starts + thick * directions, starts], dim=1)
    first, second = overlapping_boxes(torch.cat([lines, vertices[faces]]))
    line, face = torch.minimum(first, second), torch.maximum(first, second) - count
    of_both = (line < count) & (face >= 0)
    line, face = line[of_both], face[of_both]
    apart = (faces[face] != moving[line, None]).all(dim=1)
    line, face = line[apart], face[apart]
    a, b, c = (vertices[faces[face]] - starts[line, None]).unbind(1)
    along = directions[line]
    shares = torch.stack([(torch.linalg.cross(p, q) * along).sum(dim=1) for p, q in ((b, c), (c, a), (a, b))], dim=1)
    total = shares.sum(dim=1)
    way = (a * torch.linalg.cross(b, c)).sum(dim=1) / total.clamp(max=-1e-30)
    met = (shares <= 0).all(dim=1) & (total < 0) & (way > 0)
    return torch.full((count,), math.inf).to(vertices).scatter_reduce(0, line[met], way[met], "amin")


def _median_edge(vertices: Float[Tensor, "V 3"], topology: MeshTopology) -> float:
    ends = vertices[topology.edges]
    return float((ends[:, 0] - ends[:, 1]).norm(dim=1).median())
