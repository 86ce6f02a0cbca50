"""For MeshLab and Open3D, where glb is too dark."""

from pathlib import Path

import numpy as np

from etsplat.io.ply_tables import CORNERS, encode_ply
from etsplat.io.writers import Colors, Content, Surface

HOLDS: frozenset[Content] = frozenset({"vertex_colors", "face_colors", "alpha", "numbers"})


def write(path: Path, surface: Surface) -> None:
    """Binary; colours have 8 bits, at vertices and at faces, as Blender reads no others than the former."""
    columns = [("x", "f4"), ("y", "f4"), ("z", "f4"), *_color_fields(surface.vertex_colors)]
    vertex = np.empty(len(surface.vertices), columns)
    for axis, values in zip("xyz", surface.vertices.T, strict=True):
        vertex[axis] = values
    extra = [(name, "f4") for name in surface.numbers]
    face = np.empty(len(surface.faces), [(CORNERS, "i4", (3,)), *_color_fields(surface.face_colors), *extra])
    face[CORNERS] = surface.faces
    for name, values in surface.numbers.items():
        face[name] = values
    for table, colors in ((vertex, surface.vertex_colors), (face, surface.face_colors)):
        for (name, _), values in zip(_color_fields(colors), () if colors is None else colors.T, strict=True):
            table[name] = np.floor(values * 255 + 0.5)
    path.write_bytes(encode_ply({"vertex": vertex, "face": face}, surface.comment))


def _color_fields(colors: Colors) -> list[tuple[str, str]]:
    return [] if colors is None else [(name, "u1") for name in ("red", "green", "blue", "alpha")[: colors.shape[1]]]
