"""Sampling of textures in plain PyTorch."""

import torch
from jaxtyping import Float
from torch import Tensor


def sample_texture(texture: Tensor, uv: Tensor, lod: Tensor | None, levels: int) -> Float[Tensor, "N C"]:
    """See `etsplat.sample_texture`: uv (N, 2), lod (N,) or None, of so many levels."""
    if lod is None:
        return _bilinear(texture, uv)
    chosen = torch.where(lod > 0, lod.detach(), 0.0).clamp(max=levels - 1)[:, None]
    values = uv.new_zeros(len(uv), texture.shape[2])
    for level in range(levels):
        if level > 0:
            height, width, channels = texture.shape
            texture = texture.reshape(height // 2, 2, width // 2, 2, channels).mean(dim=(1, 3))
        values = values + (1 - (chosen - level).abs()).clamp(min=0) * _bilinear(texture, uv)
    return values


def _bilinear(texture: Tensor, uv: Tensor) -> Tensor:
    height, width, _ = texture.shape
    (left, right, x), (upper, lower, y) = _between(uv[:, 0], width), _between(uv[:, 1], height)
    above = torch.lerp(texture[upper, left], texture[upper, right], x)
    below = torch.lerp(texture[lower, left], texture[lower, right], x)
    return torch.lerp(above, below, y)


def _between(coordinate: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Two neighbouring texels and the way (N, 1) from the centre of the first to that of the second."""
    position = coordinate * size - 0.5
    beyond = torch.where(position.detach() > 0, float(size - 1), 0.0).to(position)  # NaN is 0
    position = torch.where((position > 0) & (position < size - 1), position, beyond)
    first = position.detach().long()
    return first, (first + 1).clamp(max=size - 1), (position - first)[:, None]
