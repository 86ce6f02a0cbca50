"""The CPU engine's side of `mesh_energies`: csrc/cpu/bind_mesh_energies.cpp."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.validation import dense


def mesh_energies(vertices: Tensor, connectivity: MeshConnectivity, edge_power: int) -> tuple[Tensor, Tensor, Tensor]:
    """See `Engine.mesh_energies`."""
    energies: Any = _MeshEnergies.apply(vertices, connectivity, edge_power)
    return energies


class _MeshEnergies(torch.autograd.Function):
    """One native call computes the values and the three gradients, which backward combines."""

    @staticmethod
    def forward(
        ctx: Any, vertices: Tensor, connectivity: MeshConnectivity, edge_power: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        vertices = dense(vertices, "vertices")
        gradients = vertices.new_empty((3, *vertices.shape))
        c = connectivity
        adjacency = (c.faces, c.neighbor_offsets, c.neighbor_indices, c.corner_offsets, c.corners, c.pair_offsets)
        edge, normal, laplacian = _native.mesh_energies(
            vertices.data_ptr(),
            *(array.data_ptr() for array in (*adjacency, c.paired_faces)),
            c.num_vertices,
            len(c.edges),
            len(c.face_pairs),
            len(c.faces),
            edge_power,
            gradients.data_ptr(),
        )
        ctx.save_for_backward(gradients)
        return vertices.new_tensor(edge), vertices.new_tensor(normal), vertices.new_tensor(laplacian)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, edge: Tensor, normal: Tensor, laplacian: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        gradients = dense(ctx.saved_tensors[0])
        combined = torch.empty_like(gradients[0])
        weights = [float(edge), float(normal), float(laplacian)]
        _native.combine_mesh_gradients(gradients.data_ptr(), weights, combined.numel(), combined.data_ptr())
        return combined, None, None
