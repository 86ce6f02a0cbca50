"""The GPU engine's side of what is minimised: csrc/cuda/photometric.cu, mesh_energies.cu and the like.

Values are sums of blocks, then the total of these, in a fixed order. Cotangents and weights stay in device memory.
"""

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from etsplat.core.connectivity import MeshConnectivity
from etsplat.engines.cuda.launch import BLOCK, blocks, launch, launch_each
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import Struct, constant, struct_class
from etsplat.engines.native.operation import differentiable

_PHOTOMETRIC = Program("photometric.cu", contract=False)
_ENERGIES = Program("mesh_energies.cu", contract=False)
_NORMALS = Program("normal_consistency.cu", contract=False)
_AREA = Program("triangle_area.cu", contract=False)
_SUM = Program("weighted_sum.cu", contract=False)
_TILE = constant("cuda/photometric.cu", "kTile")  # _TILE^2 threads


def _photometric(keep: bool, color: Tensor, *compared: Any) -> tuple[Tensor, Any]:
    """Keeps the derivatives of SSIM by its moments, which backward blurs once more; both read the images."""
    problem, grid = _compared(color, *compared)
    B, H, W = color.shape[:3]
    maps = color.new_empty((B, 3, 3, H, W)) if keep and problem.dssim_weight > 0 else None
    sums = color.new_empty((grid[0] * grid[1] * grid[2], 2), dtype=torch.float64)
    loss = color.new_empty(())
    launch(_PHOTOMETRIC, "photometric_sums", grid, _TILE * _TILE, (problem, maps, sums))
    launch(_PHOTOMETRIC, "photometric_loss", 1, _TILE * _TILE, (problem, sums, ctypes.c_int64(len(sums)), loss))
    return loss, (maps, color, *compared)


def _photometric_backward(kept: Any, _needed: Any, grad_loss: Tensor) -> tuple[Tensor]:
    maps, *compared = kept
    problem, grid = _compared(*compared)
    gradient = torch.empty_like(compared[0])
    launch(_PHOTOMETRIC, "photometric_backward", grid, _TILE * _TILE, (problem, maps, grad_loss, gradient))
    return (gradient,)


def _compared(
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    backgrounds: Tensor | None,
    dssim_weight: float,
    squared: bool,
) -> tuple[Struct, tuple[int, int, int]]:
    """The kernels' struct and their grid: tiles of a row and of a column, views."""
    views, height, width = color.shape[:3]
    images, sizes = (color, target, backgrounds, mask), (views, height, width, target.shape[-1])
    settings = target.dtype == torch.uint8, squared, dssim_weight
    struct = struct_class("cuda/photometric.cu", "Photometric")(*images, *sizes, *settings)
    return struct, (blocks(width, _TILE), blocks(height, _TILE), views)


photometric_loss = differentiable(_photometric, _photometric_backward)


def _mesh_energies(
    _keep: bool, vertices: Tensor, connectivity: MeshConnectivity, edge_power: int
) -> tuple[tuple[Tensor, ...], Any]:
    """Computes the three gradients too, which backward combines."""
    c, V, F = connectivity, len(vertices), len(connectivity.faces)
    corners, pairs = (c.corner_offsets, c.corners), (c.pair_offsets, c.paired_faces)
    arrays = (vertices, c.faces, c.neighbor_offsets, c.neighbor_indices, *corners, *pairs)
    mesh = struct_class("math/mesh_energies.h", "MeshArrays")(*arrays, V, len(c.edges), len(c.face_pairs), F)
    vertex_blocks, face_blocks = blocks(V, BLOCK), blocks(F, BLOCK)
    vertex_sums = vertices.new_empty((vertex_blocks, 2), dtype=torch.float64)
    face_sums = vertices.new_empty(face_blocks, dtype=torch.float64)
    normals, spread = vertices.new_empty((F, 4)), vertices.new_empty((V, 3))
    corner_gradients, gradients = vertices.new_empty((3 * F, 3)), vertices.new_empty((3, V, 3))
    energies = vertices.new_empty(()), vertices.new_empty(()), vertices.new_empty(())
    arguments = (mesh, edge_power, normals, spread, gradients, vertex_sums)
    launch(_ENERGIES, "mesh_elements", face_blocks + vertex_blocks, BLOCK, arguments)
    launch(_ENERGIES, "mesh_pairs", face_blocks, BLOCK, (mesh, normals, corner_gradients, face_sums))
    arguments = (mesh, spread, corner_gradients, gradients, vertex_sums, face_sums, *energies)
    launch(_ENERGIES, "mesh_gather", vertex_blocks + 1, BLOCK, arguments)
    return energies, [gradients]


def _mesh_energies_backward(kept: Any, _needed: Any, *cotangents: Tensor | None) -> tuple[Tensor]:
    (gradients,) = kept
    combined = torch.empty_like(gradients[0])
    weights = (gradients.new_zeros(()) if cotangent is None else cotangent for cotangent in cotangents)
    size = combined.numel()
    launch_each(_ENERGIES, "mesh_combine", size, (gradients, *weights, ctypes.c_int64(size), combined))
    return (combined,)


mesh_energies = differentiable(_mesh_energies, _mesh_energies_backward)


def _normal_consistency(_keep: bool, *inputs: Tensor) -> tuple[Tensor, Any]:
    """Backward computes again what this does, rather than keep it."""
    problem, grid = _depth_normals(inputs)
    sums = inputs[0].new_empty(grid[0] * grid[1], dtype=torch.float64)
    loss = inputs[0].new_empty(())
    launch(_NORMALS, "normal_sums", grid, BLOCK, (problem, sums))
    launch(_NORMALS, "normal_mean", 1, BLOCK, (problem, sums, ctypes.c_int64(len(sums)), loss))
    return loss, inputs


def _normal_consistency_backward(inputs: Any, _needed: Any, grad_loss: Tensor) -> tuple[Tensor, Tensor]:
    problem, grid = _depth_normals(inputs)
    grads = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
    launch(_NORMALS, "normal_backward", grid, BLOCK, (problem, grad_loss, *grads))
    return grads


def _depth_normals(inputs: Sequence[Tensor]) -> tuple[Struct, tuple[int, int]]:
    """The kernels' struct and their grid: blocks of a view, views."""
    views, height, width = inputs[0].shape[:3]
    struct = struct_class("cuda/normal_consistency.cu", "DepthNormals")(*inputs, views, height, width)
    return struct, (blocks(height * width, BLOCK), views)


normal_consistency = differentiable(_normal_consistency, _normal_consistency_backward)


def _mean_area(_keep: bool, vertices: Tensor) -> tuple[Tensor, Any]:
    grid = blocks(len(vertices), BLOCK)
    sums, mean = vertices.new_empty(grid, dtype=torch.float64), vertices.new_empty(())
    launch(_AREA, "area_sums", grid, BLOCK, (vertices, len(vertices), sums))
    launch(_AREA, "area_mean", 1, BLOCK, (sums, ctypes.c_int64(grid), len(vertices), mean))
    return mean, [vertices]


def _mean_area_backward(kept: Any, _needed: Any, grad_area: Tensor) -> tuple[Tensor]:
    (vertices,) = kept
    gradient = torch.empty_like(vertices)
    launch_each(_AREA, "area_backward", len(vertices), (vertices, len(vertices), grad_area, gradient))
    return (gradient,)


mean_area = differentiable(_mean_area, _mean_area_backward)


def weighted_sum(
    first: Tensor,
    values: Sequence[Tensor],
    weights: Sequence[float],
    powers: Sequence[int],
    scale: float | Tensor,
) -> Tensor:
    """See `Engine.weighted_sum`; as many terms at a time as a launch takes."""
    factor, on_host = (scale, 1.0) if isinstance(scale, Tensor) else (None, scale)
    terms_class, total = struct_class("cuda/weighted_sum.cu", "WeightedTerms"), first
    most = len(terms_class().values)
    for begin in range(0, len(values), most):
        end = begin + most
        chosen = [on_host * weight for weight in weights[begin:end]], list(powers[begin:end])
        total = _add_terms(total, *values[begin:end], chosen, factor)
    return total


def _terms(_keep: bool, first: Tensor, *given: Any) -> tuple[Tensor, Any]:
    total, (*values, settings, scale) = first.new_empty(()), given
    launch(_SUM, "weighted_sum", 1, 1, (first, _table(values, settings), scale, total))
    return total, given


def _terms_backward(kept: Any, _needed: Any, grad_sum: Tensor) -> tuple[Tensor, ...]:
    *values, settings, scale = kept
    gradients = grad_sum.new_empty(1 + len(values))
    launch(_SUM, "weighted_sum_backward", 1, 1, (_table(values, settings), scale, grad_sum, gradients))
    return gradients.unbind()


def _table(values: list[Tensor], settings: tuple[list[float], list[int]]) -> Struct:
    return struct_class("cuda/weighted_sum.cu", "WeightedTerms")(values, *settings, len(values))


_add_terms = differentiable(_terms, _terms_backward)
