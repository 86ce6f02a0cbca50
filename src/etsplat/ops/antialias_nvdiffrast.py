"""The antialiased rasterizer of nvdiffrast, where it is installed (not on PyPI, non-commercial licence, CUDA only).

For comparison with `ops/antialias.py`, behind the same signature.
"""

import importlib
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.backgrounds import for_each_view
from etsplat.core.cameras import Cameras
from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.errors import InputError
from etsplat.core.rasterization import Rasterization
from etsplat.core.spelling import option

_FAR = 1000.0


def rasterize_nvdiffrast(
    vertices: Float[Tensor, "V 3"],
    *,
    connectivity: MeshConnectivity,
    cameras: Cameras,
    face_colors: Float[Tensor, "F C"] | None = None,
    vertex_colors: Float[Tensor, "V C"] | None = None,
    backgrounds: Float[Tensor, " C"] | Float[Tensor, "B C"] | None = None,
    near_plane: float = 0.01,
) -> Rasterization:
    """As ``etsplat.rasterize_antialiased``, computed on the GPU; colour and alpha are on ``vertices``' device.

    Raises:
        InputError: nvdiffrast or a CUDA device is missing.
    """
    library = load_nvdiffrast()
    home, device = vertices.device, torch.device("cuda")
    height, width = cameras.height, cameras.width
    clip = _clip_positions(vertices, cameras.viewmats, cameras.Ks, width, height, near_plane).to(device)
    faces = connectivity.faces.to(device)
    seen, _ = library.rasterize(_context(), clip, faces, (height, width), grad_db=False)
    if vertex_colors is not None:
        colors, _ = library.interpolate(vertex_colors.to(device), seen, faces)
    else:
        assert face_colors is not None
        colors = face_colors.to(device)[(seen[..., 3].long() - 1).clamp(min=0)]
    empty = seen[..., 3:] == 0
    backgrounds = for_each_view(backgrounds, len(cameras))
    behind = colors.new_zeros(()) if backgrounds is None else backgrounds.to(device)[:, None, None, :]
    image = library.antialias(torch.where(empty, behind, colors).contiguous(), seen, clip, faces)
    return Rasterization(image.to(home), (~empty).to(home, vertices.dtype))


def load_nvdiffrast() -> Any:
    """The module `nvdiffrast.torch`.

    Raises:
        InputError: it, or a CUDA device, is missing.
    """
    if not torch.cuda.is_available():
        raise InputError(
            "drawing.backend nvdiffrast: needs a CUDA device; "
            f"leave out {option('drawing.backend')} to use etsplat's own rasterizer"
        )
    try:
        return importlib.import_module("nvdiffrast.torch")
    except ImportError as error:
        raise InputError(
            "backend nvdiffrast: is not installed; see github.com/NVlabs/nvdiffrast (its licence is non-commercial), "
            f"or leave out {option('drawing.backend')} to use etsplat's own rasterizer"
        ) from error


@cache
def _context() -> Any:
    return load_nvdiffrast().RasterizeCudaContext()


def _clip_positions(
    vertices: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, near_plane: float
) -> Float[Tensor, "B V 4"]:
    """OpenGL clip coordinates with y down, so that row 0 of the image is our row 0."""
    x, y, z = (vertices @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]).unbind(-1)
    fx, cx, fy, cy = (Ks[:, i, j, None] for i, j in ((0, 0), (0, 2), (1, 1), (1, 2)))
    depth = ((_FAR + near_plane) * z - 2 * _FAR * near_plane) / (_FAR - near_plane)
    return torch.stack(
        [2 * (fx * x + cx * z) / width - z, 2 * (fy * y + cy * z) / height - z, depth, z], dim=-1
    ).contiguous()
