"""Triangles side by side in one texture, each with texels of its own."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.validation import check_indices, check_shape

MOST_TEXELS = 1 << 12
"""Along the legs of a triangle."""

_LARGEST_SIDE = 1 << 16
_LARGEST_SQUARES = 3  # 2 n^2 < (n + 1) (n + 2)


@dataclass(frozen=True)
class TriangleAtlas:
    """Where the triangles of a mesh lie in one texture.

    Attributes:
        face_uvs: (F, 3, 2) float32 texture coordinates of corners, as `etsplat.sample_texture` has them.
        width: of the texture in texels.
        height: the same.
    """

    face_uvs: Float[Tensor, "F 3 2"]
    width: int
    height: int


def pack_triangles(texels: Int[Tensor, " F"]) -> TriangleAtlas:
    """Lay out triangles so that bilinear sampling within one reads no texel of another.

    A triangle with n texels is half a square: corner 0 in the centre of the texel at its right angle, the others n - 1
    texels from there along the legs. Sampling it reads the texels of that square up to n steps from the corner, those
    at n beyond its edge. Turned by half a circle, a second triangle shares its cell of (n + 2) x (n + 1) texels; up to
    n = 3 two squares side by side are smaller. Cells of one size stand in rows, the larger ones above; triangles of one
    size in the order of their numbers. The texture is about square. Coarser levels mix triangles: draw it with
    `max_level=0`.

    Args:
        texels: (F,) int32 or int64, along the legs of each triangle, from 1 to `MOST_TEXELS`. Few different numbers,
            such as powers of two, make full rows.

    Returns:
        The same layout for the same numbers, on their device. Which corner is corner 0 is the caller's to choose: best
        the one opposite of the longest edge.

    Raises:
        ValueError: wrong shape, dtype or numbers.
        InputError: a texture of 65,536 texels along a side does not hold them.
    """
    check_shape("texels", texels, ("F",))
    check_indices("texels", texels, MOST_TEXELS + 1)
    if len(texels) == 0 or int(texels.min()) < 1:
        raise ValueError("texels must be numbers of at least 1, of one triangle or more")
    sizes, counts = texels.long().unique(return_counts=True)
    sizes, pairs = sizes.flip(0), (counts.flip(0) + 1) // 2
    squares = sizes <= _LARGEST_SQUARES
    columns, rows = torch.where(squares, 2 * sizes, sizes + 2), torch.where(squares, sizes, sizes + 1)  # of a cell
    area = int((pairs * columns * rows).sum())
    width = max(int(columns.max()), round(area**0.5))
    per_row = width // columns
    shelves = -(-pairs // per_row) * rows
    tops = shelves.cumsum(0) - shelves
    height = int(shelves.sum())
    if max(width, height) > _LARGEST_SIDE:
        raise InputError(f"a texture of {width} x {height} texels is larger than {_LARGEST_SIDE}: ask for fewer texels")

    order = texels.long().argsort(descending=True, stable=True)  # by size, then number
    kind = torch.arange(len(sizes), device=texels.device).repeat_interleave(counts.flip(0))
    place = torch.arange(len(order), device=texels.device) - (counts.flip(0).cumsum(0) - counts.flip(0))[kind]
    cell, turned = place // 2, place % 2 == 1
    left = cell % per_row[kind] * columns[kind]
    top = tops[kind] + cell // per_row[kind] * rows[kind]
    leg = sizes[kind] - 1
    near = torch.stack([left, top], dim=1) + 0.5
    far = torch.stack([left + columns[kind], top + rows[kind]], dim=1) - 0.5
    corner = torch.where(turned[:, None], far, near)
    step = torch.where(turned, -leg, leg)
    along = torch.stack([torch.zeros_like(step), step, torch.zeros_like(step)], dim=1)  # of corners 0, 1, 2
    down = torch.stack([torch.zeros_like(step), torch.zeros_like(step), step], dim=1)
    positions = corner[:, None].double() + torch.stack([along, down], dim=2)
    uvs = torch.empty(len(texels), 3, 2, dtype=torch.float64, device=texels.device)
    uvs[order] = positions / positions.new_tensor([width, height])
    return TriangleAtlas(uvs.float(), width, height)
