"""Do the normals of the triangles agree with those of the depth image (2D Gaussian splatting's normal loss)?

    L_n = mean (1 - <n, A m>),    m = normalize(d_rows P x d_columns P)

over all pixels, with n the blended normals, A the coverage (held constant) and P the points of the depth image in the
world, differentiated centrally. On the border of one pixel, and where the points do not span a plane, m is 0.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.validation import check_like, check_shape, dense
from etsplat.ops._normal_consistency_cuda import NormalConsistencyCuda
from etsplat.ops.engines import resolve_engine
from etsplat.ops.pool import empty_image


def normal_consistency(
    normals: Float[Tensor, "B H W 3"],
    depth: Float[Tensor, "B H W 1"],
    alpha: Float[Tensor, "B H W 1"],
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
    *,
    engine: str | None = None,
) -> Float[Tensor, ""]:
    """Mean disagreement of two kinds of normals.

    Args:
        normals: (B, H, W, 3) in world space, turned to the camera, not renormalised.
        depth: (B, H, W, 1) z of the surface, for instance the median depth.
        alpha: (B, H, W, 1) coverage; receives no gradient.
        viewmats: (B, 4, 4) world to camera.
        Ks: (B, 3, 3) intrinsics.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        Scalar; gradients reach normals and depth. The native engines add in a fixed order: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device; an empty image.
    """
    image = tuple(normals.shape[:3])
    check_shape("normals", normals, ("B", "H", "W", 3))
    for name, tensor, shape in (
        ("depth", depth, (*image, 1)),
        ("alpha", alpha, (*image, 1)),
        ("viewmats", viewmats, (image[0], 4, 4)),
        ("Ks", Ks, (image[0], 3, 3)),
    ):
        check_shape(name, tensor, shape)
        check_like(name, tensor, "normals", normals)
    if normals.numel() == 0:
        raise ValueError(f"normals must hold at least one pixel, got shape {tuple(normals.shape)}")
    chosen = resolve_engine(engine, normals)
    if chosen != "reference":
        native = NormalConsistencyCuda if chosen == "cuda" else _NormalConsistency
        loss: Any = native.apply(normals, depth, alpha.detach(), viewmats.detach(), Ks.detach())
        return loss
    facing = depth_normals(depth, viewmats, Ks)
    return (1 - (normals * facing * alpha.detach()).sum(dim=-1)).mean()


def depth_normals(
    depth: Float[Tensor, "B H W 1"], viewmats: Float[Tensor, "B 4 4"], Ks: Float[Tensor, "B 3 3"]
) -> Float[Tensor, "B H W 3"]:
    """Normals of a depth image in world space, turned to the camera; 0 on the border and where there is no plane."""
    height, width = depth.shape[1:3]
    rows = torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5
    columns = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5
    x = (columns - Ks[:, None, None, 0, 2]) / Ks[:, None, None, 0, 0]
    y = (rows[:, None] - Ks[:, None, None, 1, 2]) / Ks[:, None, None, 1, 1]
    rays = torch.stack(torch.broadcast_tensors(x, y, torch.ones_like(depth[..., 0])), dim=-1)
    points = depth * rays
    down = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    right = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    normal = torch.linalg.cross(down, right)
    square = normal.square().sum(dim=-1, keepdim=True)
    usable = square > 0
    unit = torch.where(usable, normal / torch.where(usable, square, 1).sqrt(), 0)
    world = torch.einsum("bji,bhwj->bhwi", viewmats[:, :3, :3], unit)
    return torch.nn.functional.pad(world, (0, 0, 1, 1, 1, 1))


class _NormalConsistency(torch.autograd.Function):
    """One pass computes the value and the derivatives, which wait for backward."""

    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        inputs = [dense(tensor) for tensor in given]
        normals, depth = inputs[:2]
        height, width = normals.shape[1:3]
        derivatives = [empty_image(*tensor.shape) for tensor in (normals, depth) if any(ctx.needs_input_grad)]
        total = 0.0
        for b in range(len(normals)):
            views = (tensor[b].data_ptr() for tensor in inputs)
            outputs = [tensor[b].data_ptr() for tensor in derivatives] or [0, 0]
            total += _native.normal_agreement(*views, height, width, *outputs)
        ctx.save_for_backward(*derivatives)
        return normals.new_tensor(1.0 - total / depth.numel())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        derivatives = ctx.saved_tensors
        scale = -float(grad_loss) / derivatives[1].numel()
        grads = (torch.mul(tensor, scale, out=empty_image(*tensor.shape)) for tensor in derivatives)
        return *grads, None, None, None
