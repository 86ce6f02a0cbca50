"""Opacities, softness and colours of a soup as they are drawn, in plain PyTorch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import SOUP_SIGMA_FLOOR
from etsplat.core.soup_numbers import SoupNumbers

_MIN_LENGTH = 1e-12


def soup_activation(
    vertices: Tensor,
    opacity_logits: Tensor,
    sigma_raw: Tensor,
    numbers: SoupNumbers | Tensor,
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[Tensor, Tensor]:
    """See `etsplat.ops.soup_activation`."""
    floor, ceiling, dropout, draw = numbers
    opacities = floor + (1.0 - floor) * torch.sigmoid(opacity_logits)
    if camera is not None:
        opacities = torch.where(_left_out(vertices, camera, smallest, largest), 0.0, opacities)
    opacities = torch.where(_dropped(len(vertices), float(dropout), int(draw), vertices.device), 0.0, opacities)
    return opacities, (SOUP_SIGMA_FLOOR + torch.exp(sigma_raw)).clamp_max(ceiling)


def _dropped(count: int, dropout: float, draw: int, device: torch.device) -> Bool[Tensor, " N"]:
    """Which triangles a draw leaves out: those whose hash, as a fraction of the largest, is below the share."""
    rows = torch.arange(count, device=device)
    fraction = (_mixed_bits(rows ^ _mixed_bits(torch.tensor(draw, device=device))) >> 8).float() / 2**24
    return fraction < dropout


def _mixed_bits(x: Tensor) -> Tensor:
    """Murmur3's finalizer of 32 bits, in int64."""
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    return x ^ (x >> 16)


def _left_out(vertices: Float[Tensor, "N 3 3"], camera: Cameras, smallest: float, largest: float) -> Bool[Tensor, " N"]:
    """Which triangles have a smaller inradius, 2 area / perimeter, or reach farther from their middle, projected."""
    rotation, translation = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    points = vertices @ rotation.T + translation
    pixels = points[..., :2] / points[..., 2:].clamp_min(1e-6) * torch.diagonal(camera.Ks[0])[:2]
    edges = pixels - pixels.roll(1, dims=1)
    doubled = (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).abs()
    reach = (pixels - pixels.mean(dim=1, keepdim=True)).norm(dim=-1).amax(dim=-1)
    return (doubled < smallest * edges.norm(dim=-1).sum(dim=-1)) | (reach > largest)


def spherical_harmonics(coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
    """See `etsplat.ops.spherical_harmonics`."""
    basis = _basis(directions, degree)
    return torch.relu(0.5 + torch.einsum("...nk,nkc->...nc", basis, coefficients[:, : basis.shape[-1]]))


def soup_colors(vertices: Tensor, sh_dc: Tensor, sh_rest: Tensor, centers: Tensor, degree: int) -> Tensor:
    """See `etsplat.ops.soup_colors`."""
    directions = vertices.mean(dim=1) - centers[:, None]
    return spherical_harmonics(torch.cat([sh_dc, sh_rest], dim=1), directions, degree)


def _basis(directions: Tensor, degree: int) -> Float[Tensor, "*batch K"]:
    """Y_k at the normalised directions, (..., (degree + 1)^2); the constant alone where there is no direction."""
    square = directions.square().sum(dim=-1, keepdim=True)
    usable = square > _MIN_LENGTH**2
    x, y, z = torch.where(usable, directions / torch.where(usable, square, 1).sqrt(), 0).unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [torch.full_like(x, 0.28209479177387814)],
        [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
    ]
    return torch.stack([value for band in bands[: degree + 1] for value in band], dim=-1)
