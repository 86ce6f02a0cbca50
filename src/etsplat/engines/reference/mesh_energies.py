"""The energies of a mesh as their formulas say, in plain PyTorch."""

import torch
from torch import Tensor

from etsplat.core.connectivity import MeshConnectivity

_MIN_LENGTH = 1e-12
_MIN_SHAPE = 1e-6


def mesh_energies(vertices: Tensor, connectivity: MeshConnectivity, edge_power: int) -> tuple[Tensor, Tensor, Tensor]:
    """L_e, L_n and L_lap of `etsplat.ops.mesh_energies`."""
    tail, head = vertices[connectivity.edges.long()].unbind(dim=1)
    edge = _length(head - tail) if edge_power == 1 else (head - tail).square().sum(dim=1)

    normals, usable = _normals(*vertices[connectivity.faces.long()].unbind(dim=1))
    first, second = connectivity.face_pairs.long().unbind(dim=1)
    disagreement = 1 - (normals[first] * normals[second]).sum(dim=1)
    normal = torch.where(usable[first] & usable[second], disagreement, 0)

    offsets = connectivity.neighbor_offsets.long()
    counts = offsets.diff()
    owner = torch.repeat_interleave(torch.arange(len(vertices), device=vertices.device), counts)
    sums = torch.zeros_like(vertices).index_add(0, owner, vertices[connectivity.neighbor_indices.long()])
    mean = sums / counts.clamp(min=1)[:, None]
    laplacian = _length(torch.where(counts[:, None] > 0, vertices - mean, 0))
    return _mean(edge), _mean(normal), _mean(laplacian)


def _mean(values: Tensor) -> Tensor:
    """The mean, 0 of nothing."""
    return values.sum() / max(1, len(values))


def _length(vectors: Tensor) -> Tensor:
    """Norms with zero gradient where they vanish."""
    square = vectors.square().sum(dim=1)
    positive = square > _MIN_LENGTH**2
    return torch.where(positive, torch.where(positive, square, 1).sqrt(), 0)


def _normals(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Unit normals, and which faces have one."""
    cross = torch.linalg.cross(b - a, c - a)
    longest = torch.stack([(b - a), (c - a), (c - b)]).square().sum(dim=2).amax(dim=0)
    square = cross.square().sum(dim=1)
    usable = (square > (_MIN_SHAPE * longest) ** 2).detach()
    return cross / torch.where(usable, square, 1).sqrt()[:, None], usable
