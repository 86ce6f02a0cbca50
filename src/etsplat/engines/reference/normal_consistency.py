"""Agreement of blended normals with those of the depth image, in plain PyTorch."""

import torch
from jaxtyping import Float
from torch import Tensor


def normal_consistency(normals: Tensor, depth: Tensor, alpha: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """See `etsplat.ops.normal_consistency`."""
    facing = depth_normals(depth, viewmats, Ks)
    return (1 - (normals * facing * alpha).sum(dim=-1)).mean()


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
