"""The GPU engine's side of ``mesh_energies``: csrc/cuda/mesh_energies.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import struct_class

_PROGRAM = Program("mesh_energies.cu", contract=False)
_THREADS = 256
_ARRAYS = ("faces", "neighbor_offsets", "neighbor_indices", "corner_offsets", "corners", "pair_offsets", "paired_faces")


def mesh_energies(vertices: Tensor, connectivity: MeshConnectivity, edge_power: int) -> tuple[Tensor, Tensor, Tensor]:
    """See `Engine.mesh_energies`."""
    energies: Any = _MeshEnergies.apply(vertices, connectivity, edge_power)
    return energies


class _MeshEnergies(torch.autograd.Function):
    """The three scalars; forward computes the three gradients too, which backward combines."""

    @staticmethod
    def forward(
        ctx: Any, vertices: Tensor, connectivity: MeshConnectivity, edge_power: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        vertices, c = dense(vertices, "vertices"), connectivity
        V, F = len(vertices), len(c.faces)
        addresses = (vertices.data_ptr(), *(getattr(c, name).data_ptr() for name in _ARRAYS))
        mesh = struct_class("math/mesh_energies.h", "MeshArrays")(*addresses, V, len(c.edges), len(c.face_pairs), F)
        vertex_blocks, face_blocks = blocks(V, _THREADS), blocks(F, _THREADS)
        vertex_sums = vertices.new_empty((vertex_blocks, 2), dtype=torch.float64)
        face_sums = vertices.new_empty(face_blocks, dtype=torch.float64)
        normals, spread = vertices.new_empty((F, 4)), vertices.new_empty((V, 3))
        corner_gradients, gradients = vertices.new_empty((3 * F, 3)), vertices.new_empty((3, V, 3))
        energies = vertices.new_empty(()), vertices.new_empty(()), vertices.new_empty(())
        arguments = (mesh, edge_power, normals, spread, gradients, vertex_sums)
        launch(_PROGRAM, "mesh_elements", face_blocks + vertex_blocks, _THREADS, arguments)
        launch(_PROGRAM, "mesh_pairs", face_blocks, _THREADS, (mesh, normals, corner_gradients, face_sums))
        arguments = (mesh, spread, corner_gradients, gradients, vertex_sums, face_sums, *energies)
        launch(_PROGRAM, "mesh_gather", vertex_blocks + 1, _THREADS, arguments)
        ctx.save_for_backward(gradients)
        return energies

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, edge: Tensor, normal: Tensor, laplacian: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The weights stay in device memory."""
        gradients = dense(ctx.saved_tensors[0])
        combined = torch.empty_like(gradients[0])
        size = combined.numel()
        arguments = (gradients, dense(edge), dense(normal), dense(laplacian), ctypes.c_int64(size), combined)
        launch(_PROGRAM, "mesh_combine", blocks(size, _THREADS), _THREADS, arguments)
        return combined, None, None
