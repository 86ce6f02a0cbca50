"""For MeshLab and Open3D, where glb is too dark."""

import json
from pathlib import Path

import numpy as np

from etsplat.io.atomic import atomic_write
from etsplat.io.images import encode_png
from etsplat.io.ply_tables import COLORS, CORNERS, PLACES, encode_ply
from etsplat.io.writers import Colors, Content, Surface

HOLDS: frozenset[Content] = frozenset({"vertex_colors", "face_colors", "texture", "alpha", "numbers", "z_up", "offset"})


def write(path: Path, surface: Surface) -> None:
    """Binary; colours have 8 bits, at vertices and at faces, as Blender reads no others than the former.

    With an offset coordinates are doubles.

    A line of comment for each entry of the record. A texture is NAME_ply.png beside the file, which a comment names:
    NAME.png is that of an OBJ of this name, and may be another. Its places are lists at faces, `texcoord`, counted from
    the bottom: as MeshLab has them. The mesh stays welded.
    """
    kind = "f4" if surface.offset is None else "f8"
    columns = [("x", kind), ("y", kind), ("z", kind), *_color_fields(surface.vertex_colors)]
    vertex = np.empty(len(surface.vertices), columns)
    for axis, values in zip("xyz", surface.places.T, strict=True):
        vertex[axis] = values
    extra = [(name, "f4") for name in surface.numbers]
    places = [] if surface.texture is None else [(PLACES, "f4", (6,))]
    face = np.empty(len(surface.faces), [(CORNERS, "i4", (3,)), *places, *_color_fields(surface.face_colors), *extra])
    face[CORNERS] = surface.faces
    for name, values in surface.numbers.items():
        face[name] = values
    for table, colors in ((vertex, surface.vertex_colors), (face, surface.face_colors)):
        for (name, _), values in zip(_color_fields(colors), () if colors is None else colors.T, strict=True):
            table[name] = np.floor(values * 255 + 0.5)
    comments = [surface.comment] if surface.comment else []
    if surface.texture is not None:
        uvs = surface.texture.corner_uvs
        face[PLACES] = np.stack([uvs[..., 0], 1 - uvs[..., 1]], axis=-1).reshape(-1, 6)
        picture = f"{surface.name}_ply.png"
        comments.append(f"TextureFile {picture}")
        with atomic_write(path.parent / picture) as temporary:
            temporary.write_bytes(encode_png(surface.texture.pixels))
    comments += [f"{name} {json.dumps(value)}" for name, value in surface.record.items()]
    path.write_bytes(encode_ply({"vertex": vertex, "face": face}, comments))


def _color_fields(colors: Colors) -> list[tuple[str, str]]:
    return [] if colors is None else [(name, "u1") for name in (*COLORS, "alpha")[: colors.shape[1]]]
