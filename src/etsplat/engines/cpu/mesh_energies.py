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
    energies = _native.mesh_energies(
        vertices=vertices,
        faces=connectivity.faces,
        neighbor_offsets=connectivity.neighbor_offsets,
        neighbor_indices=connectivity.neighbor_indices,
        corner_offsets=connectivity.corner_offsets,
        corners=connectivity.corners,
        pair_offsets=connectivity.pair_offsets,
        paired_faces=connectivity.paired_faces,
        edge_power=edge_power,
        gradients=gradients,
    )
    return tuple(map(vertices.new_tensor, energies)), [gradients]


def _backward(kept: Any, _needed: Any, *cotangents: Tensor | None) -> tuple[Tensor]:
    (gradients,) = kept
    combined = torch.empty_like(gradients[0])
    weights = [0.0 if cotangent is None else float(cotangent) for cotangent in cotangents]
    _native.combine_mesh_gradients(gradients=gradients, weights=weights, combined=combined)
    return (combined,)


mesh_energies = differentiable(_forward, _backward)
