"""PLY, OBJ, OFF and GLB writers: small enough to own, so that colours are exactly what the format's viewers expect."""

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from etsplat.io.ply_tables import CORNERS, encode_ply
from etsplat.io.srgb import linear_from_srgb

Colors = np.ndarray | None

OPAQUE_ALPHA = 0.99
"""Faces of GLB files with this alpha or more do not blend."""


@dataclass(frozen=True)
class Surface:
    """What is written; each format takes what it knows.

    Attributes:
        vertices: (V, 3) float32.
        faces: (F, 3).
        vertex_colors: (V, 3|4) display values in [0, 1], or None.
        face_colors: the same for faces.
        name: what importers call the object.
        numbers: further values per face, by name.
        comment: a line of text.
    """

    vertices: np.ndarray
    faces: np.ndarray
    vertex_colors: Colors
    face_colors: Colors
    name: str
    numbers: Mapping[str, np.ndarray]
    comment: str | None = None


def write_ply(path: Path, surface: Surface) -> None:
    """Binary PLY with all there is; colours have 8 bits."""
    s = surface
    vertex = np.empty(len(s.vertices), [("x", "f4"), ("y", "f4"), ("z", "f4"), *_color_fields(s.vertex_colors)])
    for axis, values in zip("xyz", s.vertices.T, strict=True):
        vertex[axis] = values
    extra = [(name, "f4") for name in s.numbers]
    face = np.empty(len(s.faces), [(CORNERS, "i4", (3,)), *_color_fields(s.face_colors), *extra])
    face[CORNERS] = s.faces
    for name, values in s.numbers.items():
        face[name] = values
    for table, colors in ((vertex, s.vertex_colors), (face, s.face_colors)):
        for (name, _), values in zip(_color_fields(colors), () if colors is None else colors.T, strict=True):
            table[name] = np.floor(values * 255 + 0.5)
    path.write_bytes(encode_ply({"vertex": vertex, "face": face}, s.comment))


def _color_fields(colors: Colors) -> list[tuple[str, str]]:
    return [] if colors is None else [(name, "u1") for name in ("red", "green", "blue", "alpha")[: colors.shape[1]]]


def write_obj(path: Path, surface: Surface) -> None:
    """Wavefront OBJ; colours of vertices follow the coordinates, the extension that MeshLab and Blender read."""
    rows, colors = surface.vertices, surface.vertex_colors
    if colors is not None:
        rows = np.hstack([rows, colors[:, :3].astype(np.float32)])
    line = "v " + " ".join(["%.9g"] * 3 + ["%.6g"] * (rows.shape[1] - 3))
    with open(path, "w", encoding="ascii", newline="\n") as file:
        np.savetxt(file, rows, fmt=line)
        np.savetxt(file, surface.faces + 1, fmt="f %d %d %d")


def write_off(path: Path, surface: Surface) -> None:
    """OFF; colours of faces follow the corners as whole numbers from 0 to 255."""
    rows = np.hstack([np.full((len(surface.faces), 1), 3), surface.faces])
    if surface.face_colors is not None:
        rows = np.hstack([rows, np.floor(surface.face_colors * 255 + 0.5).astype(np.int64)])
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"OFF\n{len(surface.vertices)} {len(rows)} 0\n")
        np.savetxt(file, surface.vertices, fmt="%.9g")
        np.savetxt(file, rows, fmt="%d")


def write_glb(path: Path, surface: Surface) -> None:
    """Binary glTF 2.0. Colours of vertices, display values, become linear COLOR_0 under an unlit material.

    With (V, 4) the last channel is alpha. Faces with all corners above `OPAQUE_ALPHA` are a primitive of their own and
    stay opaque: viewers sort what blends by mesh at best, and do not let it hide anything. COLOR_0 has an alpha in any
    case, as programs that read with Assimp take one that is missing for 0.
    """
    vertices, faces, colors = surface.vertices, surface.faces, surface.vertex_colors
    parts = [(faces, "OPAQUE")]
    if colors is not None and colors.shape[1] == 4:
        solid = (colors[:, 3] >= OPAQUE_ALPHA)[faces].all(axis=1)
        parts = [(part, mode) for part, mode in ((faces[solid], "OPAQUE"), (faces[~solid], "BLEND")) if len(part)]
    arrays = [("VEC3", vertices.astype("<f4"))]
    attributes = {"POSITION": 0}
    if colors is not None:
        linear = np.ones((len(colors), 4))
        linear[:, : colors.shape[1]] = np.hstack([linear_from_srgb(colors[:, :3]), colors[:, 3:]])
        attributes["COLOR_0"] = len(arrays)
        arrays.append(("VEC4", linear.astype("<f4")))
    primitives = []
    for part, _ in parts:
        primitives.append({"attributes": attributes, "indices": len(arrays), "mode": 4, "material": len(primitives)})
        arrays.append(("SCALAR", part.astype("<u4").reshape(-1)))
    views, accessors, offset = [], [], 0
    for kind, array in arrays:
        component, target = (5125, 34963) if kind == "SCALAR" else (5126, 34962)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": len(accessors), "count": len(array), "componentType": component, "type": kind})
        offset += array.nbytes
    accessors[0] |= {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    document = {
        "asset": {"version": "2.0", "generator": "etsplat"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": surface.name}],
        "meshes": [{"primitives": primitives, "name": surface.name}],
        "materials": [_gltf_material(mode, unlit=colors is not None) for _, mode in parts],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    if colors is not None:
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(array.tobytes() for _, array in arrays)  # every array is a multiple of 4 bytes
    with open(path, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(data), b"BIN\0") + data)


def _gltf_material(mode: str, *, unlit: bool) -> dict[str, Any]:
    """Two-sided. Colours already hold the scene's light, so a viewer must not light them again: unlit."""
    material: dict[str, Any] = {
        "name": mode.lower(),
        "doubleSided": True,
        "alphaMode": mode,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    }
    return {**material, "extensions": {"KHR_materials_unlit": {}}} if unlit else material


WRITERS: dict[str, Callable[[Path, Surface], None]] = {
    ".ply": write_ply,
    ".obj": write_obj,
    ".off": write_off,
    ".glb": write_glb,
}
"""By suffix, lower case."""

COLORED_BY_FACE = (".off",)
"""Formats that know colours of faces alone."""
