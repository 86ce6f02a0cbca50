"""The CPU engine's side of `mesh_energies`: csrc/cpu/bind_mesh_energies.cpp."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.connectivity import MeshConnectivity
from etsplat.engines.native.operation import differentiable


def _forward(
    _keep: bool, vertices: Tensor, connectivity: MeshConnectivity, edge_power: int
) -> tuple[tuple[Tensor, ...], Any]:
    """One native call computes the values and the three gradients, which backward combines."""
    gradients = vertices.new_empty((3, *vertices.shape))
    c = connectivity
    adjacency = (c.faces, c.neighbor_offsets, c.neighbor_indices, c.corner_offsets, c.corners, c.pair_offsets)
    energies = _native.mesh_energies(
        vertices.data_ptr(),
        *(array.data_ptr() for array in (*adjacency, c.paired_faces)),
        c.num_vertices,
        len(c.edges),
        len(c.face_pairs),
        len(c.faces),
        edge_power,
        gradients.data_ptr(),
    )
    return tuple(map(vertices.new_tensor, energies)), [gradients]


def _backward(kept: Any, _needed: Any, *cotangents: Tensor | None) -> tuple[Tensor]:
    (gradients,) = kept
    combined = torch.empty_like(gradients[0])
    weights = [0.0 if cotangent is None else float(cotangent) for cotangent in cotangents]
    _native.combine_mesh_gradients(gradients.data_ptr(), weights, combined.numel(), combined.data_ptr())
    return (combined,)


mesh_energies = differentiable(_forward, _backward)
