"""For Blender, game engines and the web (Unity with the package com.unity.cloud.gltfast)."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from etsplat.io.srgb import linear_from_srgb
from etsplat.io.writers import Content, Surface

HOLDS: frozenset[Content] = frozenset({"vertex_colors", "alpha"})

OPAQUE_ALPHA = 0.99
"""Faces with this alpha or more do not blend."""


def write(path: Path, surface: Surface) -> None:
    """Binary glTF 2.0. Colours of vertices, display values, become linear COLOR_0 under an unlit material.

    With (V, 4) the last channel is alpha. Faces with all corners above `OPAQUE_ALPHA` are a primitive of their own and
    stay opaque: viewers sort what blends by mesh at best, and do not let it hide anything. COLOR_0 has an alpha in any
    case, as programs that read with Assimp take one that is missing for 0. The surface's name is what importers
    call the object.
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
