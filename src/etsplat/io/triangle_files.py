"""Separate triangles with a colour each, as Blender, MeshLab, three.js and Unity read them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from etsplat.io.surface import Surface
from etsplat.io.surface_files import save_surface, writer_of


def save_triangles(
    path: Path | str,
    vertices: Float[Tensor, "N 3 3"],
    colors: Float[Tensor, "N C"],
    *,
    weld: bool = False,
    numbers: Mapping[str, Float[Tensor, " N"]] | None = None,
    comment: str | None = None,
) -> None:
    """Write triangles, each in exactly its colour. Atomic.

    OBJ and GLB know only colours of vertices, and Blender reads no others from PLY: PLY has them twice, at its vertices
    and at its faces. Colours are display values (sRGB); glTF wants linear light, so GLB is converted, and its material
    is unlit. Colours have 8 bits in PLY and OFF.

    Args:
        path: ends in what a module of `etsplat.io.writers` writes: .ply, .obj, .off or .glb.
        vertices: (N, 3, 3) finite positions.
        colors: (N, 3), or (N, 4) with alpha, which files without room for it leave out; in [0, 1] (others are clamped).
        weld: triangles share vertices at equal positions, where their colours are equal too
            (in files without colours at vertices: all of them).
        numbers: further values per face, by name; only PLY has room for them.
        comment: a line of text; only PLY has room for it.

    Raises:
        ValueError: another suffix or wrong shapes.
        InputError: the file cannot be written.
    """
    path = Path(path)
    holds = writer_of(path).HOLDS
    if vertices.shape[1:] != (3, 3) or colors.shape not in ((len(vertices), 3), (len(vertices), 4)):
        raise ValueError(f"vertices, colors: expected (N, 3, 3), (N, 3|4); got {vertices.shape}, {colors.shape}")
    corners = vertices.detach().cpu().numpy().astype(np.float32).reshape(-1, 3)
    face_colors = colors.detach().cpu().double().clamp(0, 1).numpy()
    corner_colors = np.repeat(face_colors, 3, axis=0) if "vertex_colors" in holds else None
    points, faces, point_colors = _indexed(corners, corner_colors, weld)
    extra = {name: value.detach().cpu().numpy() for name, value in (numbers or {}).items()}
    save_surface(path, Surface(points, faces, point_colors, face_colors, extra, comment, path.stem))


def _indexed(
    corners: np.ndarray, colors: np.ndarray | None, weld: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Points (V, 3), faces (N, 3) and colours (V, C) of corners (3 N, 3)."""
    if not weld:
        return corners, np.arange(len(corners)).reshape(-1, 3), colors
    keys = corners if colors is None else np.hstack([corners, colors.astype(np.float32)])
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # keep the order of the corners
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    kept = first[order]
    return corners[kept], rank[inverse.reshape(-1)].reshape(-1, 3), None if colors is None else colors[kept]
