"""For programs that read neither glb nor ply; colours at vertices."""

import json
from pathlib import Path
from typing import TextIO

import numpy as np

from etsplat.io.atomic import atomic_write
from etsplat.io.images import encode_png
from etsplat.io.writers import Content, Surface, SurfaceTexture

HOLDS: frozenset[Content] = frozenset({"vertex_colors", "texture", "objects", "z_up", "offset"})

_MATERIAL = "surface"


def write(path: Path, surface: Surface) -> None:
    """Wavefront OBJ; colours follow the coordinates, the extension that MeshLab and Blender read.

    A line of comment for each entry of the record. With a sky there are two objects, `o NAME` and `o sky`. A texture is
    NAME.png beside the file, and NAME.mtl says so; the mesh stays welded.
    """
    if surface.texture is not None:
        _write_material(path.parent, surface.name, surface.texture)
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        for name, value in surface.record.items():
            file.write(f"# {name} {json.dumps(value)}\n")
        if surface.texture is not None:
            file.write(f"mtllib {surface.name}.mtl\n")
        if surface.sky is None:
            _write_object(file, surface, 1)
            return
        file.write(f"o {json.dumps(surface.name)[1:-1]}\n")  # in ASCII
        _write_object(file, surface, 1)
        file.write("o sky\n")
        _write_object(file, surface.sky, 1 + len(surface.vertices))


def _write_object(file: TextIO, surface: Surface, first: int) -> None:
    """Vertices and faces, where the first vertex has the number `first` in its file."""
    rows, colors = surface.places, surface.vertex_colors
    if colors is not None:
        rows = np.hstack([rows, colors[:, :3].astype(np.float32)])
    line = "v " + " ".join([surface.digits] * 3 + ["%.6g"] * (rows.shape[1] - 3))
    np.savetxt(file, rows, fmt=line)
    if surface.texture is None:
        np.savetxt(file, surface.faces + first, fmt="f %d %d %d")
        return
    corners = surface.texture.corner_uvs.reshape(-1, 2).astype(np.float64)
    uvs, numbers = np.unique(corners, axis=0, return_inverse=True)
    np.savetxt(file, np.column_stack([uvs[:, 0], 1 - uvs[:, 1]]), fmt="vt %.9g %.9g")  # counted from the bottom
    file.write(f"usemtl {_MATERIAL}\n")
    pairs = np.stack([surface.faces + first, numbers.reshape(-1, 3) + 1], axis=-1)
    np.savetxt(file, pairs.reshape(-1, 6), fmt="f %d/%d %d/%d %d/%d")


def _write_material(folder: Path, name: str, texture: SurfaceTexture) -> None:
    """The picture and what names it; what a viewer lights, it lights evenly."""
    with atomic_write(folder / f"{name}.png") as temporary:
        temporary.write_bytes(encode_png(texture.pixels))
    with atomic_write(folder / f"{name}.mtl") as temporary:
        text = f"newmtl {_MATERIAL}\nKa 1 1 1\nKd 1 1 1\nillum 0\nmap_Kd {name}.png\n"
        temporary.write_text(text, encoding="utf-8", newline="\n")
