"""A mesh cut into charts that lie flat in one square texture (xatlas)."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.validation import check_count, check_indices, check_shape
from etsplat.ops.rasterize_opaque import rasterize_opaque

GUTTER = 4
"""Texels around each chart, in a texture of `GUTTER_AT` texels a side; in larger ones as many times more."""

GUTTER_AT = 1024


def unwrapped(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], size: int) -> Float[Tensor, "F 3 2"]:
    """Texture coordinates of corners, (0, 0) in the upper left corner; charts do not overlap. Deterministic.

    Charts are apart by `GUTTER` texels at least, so that coarser levels of the texture do not mix them at once.

    Args:
        vertices: (V, 3) finite.
        faces: (F, 3), at least one.
        size: texels along each side of the texture, which the gutters are made for, at least 16.

    Raises:
        ValueError: wrong shape, index or number.
        InputError: xatlas is not installed.
    """
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    check_indices("faces", faces, len(vertices))
    size = check_count("size", size, least=16)
    xatlas = load_xatlas()
    atlas, options = xatlas.Atlas(), xatlas.PackOptions()
    options.resolution, options.padding = size, max(1, GUTTER * size // GUTTER_AT)
    options.bilinear, options.rotate_charts = True, True
    points, triangles = vertices.detach().cpu().float().numpy(), faces.cpu().int().numpy().astype("uint32")
    atlas.add_mesh(points, triangles)
    atlas.generate(pack_options=options)
    _, corners, uvs = atlas[0]
    return torch.from_numpy(uvs[corners.astype("int64")]).to(vertices).clamp(0, 1)


def texel_points(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], face_uvs: Float[Tensor, "F 3 2"], size: int
) -> tuple[Bool[Tensor, "H W"], Float[Tensor, "N 3"], Int64[Tensor, " N"]]:
    """Where on the surface the centres of a square texture's texels are.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        face_uvs: (F, 3, 2) of charts that do not overlap.
        size: texels along each side.

    Returns:
        Which texels have a place, (size, size); and the points of these N and their faces, row by row.
    """
    # Seen from one step in front of it, with the texture's width for a focal length, the layout is the picture.
    flat = torch.cat([face_uvs, torch.ones_like(face_uvs[..., :1])], dim=-1)
    K = torch.diag(flat.new_tensor([size, size, 1]))[None]
    seen = rasterize_opaque(flat, cameras=Cameras(torch.eye(4).to(flat)[None], K, size, size))
    assert seen.triangle is not None
    assert seen.barycentrics is not None
    covered = seen.triangle[0] >= 0
    face = seen.triangle[0][covered].long()
    weights = seen.barycentrics[0][covered]
    return covered, (weights[..., None] * vertices.detach()[faces[face].long()]).sum(dim=1), face


def load_xatlas() -> Any:
    """The package; InputError, which says how to install it, where it is missing."""
    try:
        import xatlas
    except ImportError as error:
        raise InputError("textures need xatlas: pip install 'etsplat[texture]'") from error
    return xatlas
