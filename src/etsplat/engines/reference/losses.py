"""What is minimised, as the formulas say, in plain PyTorch."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.connectivity import MeshConnectivity

_C1, _C2 = 0.01**2, 0.03**2  # of SSIM, as are the reach and the width of its window
_REACH, _SIGMA = 5, 1.5
_MIN_LENGTH = 1e-12
_MIN_SHAPE = 1e-6


def photometric_loss(
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    backgrounds: Tensor | None,
    dssim_weight: float,
    squared: bool,
) -> Tensor:
    """See `etsplat.ops.photometric`."""
    y = target.to(color.dtype) / 255 if target.dtype == torch.uint8 else target
    if y.shape[-1] == 4:
        behind = 0 if backgrounds is None else (1 - y[..., 3:]) * backgrounds[:, None, None, :]
        y = y[..., :3] + behind
    x = color if mask is None else y + mask[..., None] * (color - y)
    difference = (x - y).square().mean() if squared else (x - y).abs().mean()
    if dssim_weight == 0:
        return difference
    return (1 - dssim_weight) * difference + dssim_weight * (1 - _similarity(x, y).mean())


def _similarity(x: Float[Tensor, "B H W 3"], y: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B H W 3"]:
    """SSIM at every pixel and channel."""
    mean_x, mean_y, square_x, square_y, product = (_blur(image) for image in (x, y, x * x, y * y, x * y))
    variances = square_x - mean_x**2 + square_y - mean_y**2
    covariance = product - mean_x * mean_y
    return ((2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)) / ((mean_x**2 + mean_y**2 + _C1) * (variances + _C2))


def _blur(image: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B H W 3"]:
    """The separable Gaussian window; beyond the border there are zeros."""
    offsets = torch.arange(-_REACH, _REACH + 1, dtype=image.dtype, device=image.device)
    window = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    window = window / window.sum()
    flat = image.movedim(-1, 1).reshape(-1, 1, *image.shape[1:3])
    flat = torch.nn.functional.conv2d(flat, window.view(1, 1, -1, 1), padding=(_REACH, 0))
    flat = torch.nn.functional.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, _REACH))
    return flat.reshape(len(image), 3, *image.shape[1:3]).movedim(1, -1)


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


def mean_area(vertices: Tensor) -> Tensor:
    """See `etsplat.ops.triangle_area`."""
    first, second = vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]
    return 0.5 * torch.linalg.cross(first, second).norm(dim=1).mean()


def weighted_sum(
    first: Tensor,
    values: Sequence[Tensor],
    weights: Sequence[float],
    powers: Sequence[int],
    scale: float | Tensor,
) -> Tensor:
    """See `etsplat.ops.weighted_sum`; at least one value."""
    powered = (value if power == 1 else value.pow(power) for value, power in zip(values, powers, strict=True))
    total, *others = (weight * value for weight, value in zip(weights, powered, strict=True))
    for other in others:
        total = total + other
    return first + scale * total
