"""PLY, OBJ, OFF and GLB writers: small enough to own, so that colours are exactly what the format's viewers expect."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from etsplat.io.ply_tables import CORNERS, encode_ply
from etsplat.io.srgb import linear_from_srgb

Colors = np.ndarray | None

OPAQUE_ALPHA = 0.99
"""Faces of GLB files with this alpha or more do not blend."""


def write_ply(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    vertex_colors: Colors,
    face_colors: Colors,
    numbers: Mapping[str, np.ndarray] | None = None,
    comment: str | None = None,
) -> None:
    """Binary PLY; colours (V, 3|4) and (F, 3|4) have 8 bits. `numbers` are further values per face, by name."""
    vertex = np.empty(len(vertices), [("x", "f4"), ("y", "f4"), ("z", "f4"), *_color_fields(vertex_colors)])
    for axis, values in zip("xyz", vertices.T, strict=True):
        vertex[axis] = values
    extra = [(name, "f4") for name in numbers or {}]
    face = np.empty(len(faces), [(CORNERS, "i4", (3,)), *_color_fields(face_colors), *extra])
    face[CORNERS] = faces
    for name, values in (numbers or {}).items():
        face[name] = values
    for table, colors in ((vertex, vertex_colors), (face, face_colors)):
        for (name, _), values in zip(_color_fields(colors), () if colors is None else colors.T, strict=True):
            table[name] = np.floor(values * 255 + 0.5)
    path.write_bytes(encode_ply({"vertex": vertex, "face": face}, comment))


def _color_fields(colors: Colors) -> list[tuple[str, str]]:
    return [] if colors is None else [(name, "u1") for name in ("red", "green", "blue", "alpha")[: colors.shape[1]]]


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray, colors: Colors) -> None:
    """Wavefront OBJ; colours (V, 3) follow the coordinates, the extension that MeshLab and Blender read."""
    rows = vertices if colors is None else np.hstack([vertices, colors.astype(np.float32)])
    line = "v " + " ".join(["%.9g"] * 3 + ["%.6g"] * (rows.shape[1] - 3))
    with open(path, "w", encoding="ascii", newline="\n") as file:
        np.savetxt(file, rows, fmt=line)
        np.savetxt(file, faces + 1, fmt="f %d %d %d")


def write_off(path: Path, vertices: np.ndarray, faces: np.ndarray, colors: Colors) -> None:
    """OFF; `colors` (F, 3) or (F, 4) per face follow the corners as whole numbers from 0 to 255."""
    rows = np.hstack([np.full((len(faces), 1), 3), faces])
    if colors is not None:
        rows = np.hstack([rows, np.floor(colors * 255 + 0.5).astype(np.int64)])
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"OFF\n{len(vertices)} {len(faces)} 0\n")
        np.savetxt(file, vertices, fmt="%.9g")
        np.savetxt(file, rows, fmt="%d")


def write_glb(path: Path, vertices: np.ndarray, faces: np.ndarray, colors: Colors, name: str) -> None:
    """Binary glTF 2.0. Colours of vertices, display values, become linear COLOR_0 under an unlit material.

    With (V, 4) the last channel is alpha. Faces with all corners above `OPAQUE_ALPHA` are a primitive of their own and
    stay opaque: viewers sort what blends by mesh at best, and do not let it hide anything. COLOR_0 has an alpha in any
    case, as programs that read with Assimp take one that is missing for 0. `name` is what importers call the object.
    """
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
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"primitives": primitives, "name": name}],
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
