"""The CPU engine's side of what is minimised. One pass computes values and gradients, which wait for backward."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.connectivity import MeshConnectivity
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _kept_gradient(kept: Any, _needed: Any, cotangent: Tensor) -> tuple[Tensor]:
    (gradient,) = kept
    # Nearly always the loss is a plain term of the objective; then its gradient is ready as it is.
    return (gradient if float(cotangent) == 1.0 else gradient * cotangent,)


def _photometric(
    keep: bool,
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    backgrounds: Tensor | None,
    dssim_weight: float,
    squared: bool,
) -> tuple[Tensor, Any]:
    gradient = empty_image(*color.shape) if keep else None
    loss = _native.photometric(
        color=color,
        target=target,
        backgrounds=backgrounds,
        mask=mask,
        gradient=gradient,
        squared=squared,
        dssim_weight=dssim_weight,
    )
    return torch.tensor(loss), [gradient]


photometric_loss = differentiable(_photometric, _kept_gradient)


def _mesh_energies(
    _keep: bool, vertices: Tensor, connectivity: MeshConnectivity, edge_power: int
) -> tuple[tuple[Tensor, ...], Any]:
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


def _mesh_energies_backward(kept: Any, _needed: Any, *cotangents: Tensor | None) -> tuple[Tensor]:
    (gradients,) = kept
    combined = torch.empty_like(gradients[0])
    weights = [0.0 if cotangent is None else float(cotangent) for cotangent in cotangents]
    _native.combine_mesh_gradients(gradients=gradients, weights=weights, combined=combined)
    return (combined,)


mesh_energies = differentiable(_mesh_energies, _mesh_energies_backward)


def _normal_consistency(
    keep: bool, normals: Tensor, depth: Tensor, alpha: Tensor, viewmats: Tensor, Ks: Tensor
) -> tuple[Tensor, Any]:
    by_normals, by_depth = (empty_image(*tensor.shape) if keep else None for tensor in (normals, depth))
    total = _native.normal_agreement(
        normals=normals, depth=depth, alpha=alpha, viewmats=viewmats, Ks=Ks, by_normals=by_normals, by_depth=by_depth
    )
    return normals.new_tensor(1.0 - total / depth.numel()), (by_normals, by_depth)


def _normal_consistency_backward(derivatives: Any, _needed: Any, grad_loss: Tensor) -> list[Tensor]:
    scale = -float(grad_loss) / derivatives[1].numel()
    return [torch.mul(tensor, scale, out=empty_image(*tensor.shape)) for tensor in derivatives]


normal_consistency = differentiable(_normal_consistency, _normal_consistency_backward)


def _mean_area(_keep: bool, vertices: Tensor) -> tuple[Tensor, Any]:
    gradient = empty_image(*vertices.shape)
    mean = _native.mean_area(vertices=vertices, gradient=gradient)
    return vertices.new_tensor(mean), [gradient]


mean_area = differentiable(_mean_area, _kept_gradient)
