"""What the native engines' textures have in common."""

from torch import Tensor


def coarser_size(texture: Tensor, levels: int) -> int:
    """Numbers in the levels beside the first, as csrc/math/texture.h lays them out."""
    height, width, channels = texture.shape
    return sum((height >> level) * (width >> level) * channels for level in range(1, levels))
