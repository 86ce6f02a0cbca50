"""For Blender, game engines and the web (Unity with the package com.unity.cloud.gltfast)."""

import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from etsplat.io.images import encode_png
from etsplat.io.srgb import linear_from_srgb
from etsplat.io.writers import Content, Surface, SurfaceTexture

HOLDS: frozenset[Content] = frozenset({"vertex_colors", "texture", "alpha", "objects", "normals", "offset"})

_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071

OPAQUE_ALPHA = 0.99
"""Faces with this alpha or more do not blend."""


def write(path: Path, surface: Surface) -> None:
    """Binary glTF 2.0. Colours of vertices, display values, become linear COLOR_0 under an unlit material.

    So does a texture, as a PNG within the file, which glTF takes for display values as it is. Where faces have other
    texture coordinates at a vertex, it is written once for each. With a relief the material is lit, and has a normal
    map; vertices then have normals and tangents.

    With (V, 4) the last channel is alpha. Faces with all corners above `OPAQUE_ALPHA` are a primitive of their own and
    stay opaque: viewers sort what blends by mesh at best, and do not let it hide anything. COLOR_0 has an alpha in any
    case, as programs that read with Assimp take one that is missing for 0. The surface's name is what importers
    call the object. The sky is a node of its own, seen from inside alone: from outside one looks through it. The record
    is in the extras of `asset`. An offset is the translation of the nodes, which JSON has in float64; they turn z to +y
    where that is up.
    """
    content = _Content()
    content.add(surface.name, surface, lambda mode: mode.lower(), double_sided=True)
    if surface.sky is not None:
        solid = surface.sky.vertex_colors
        solid = None if solid is None else solid[:, :3]  # nothing is behind it to blend with
        content.add("sky", replace(surface.sky, vertex_colors=solid), lambda mode: "sky", double_sided=False)
    placed = _node(surface)
    document = {
        "asset": {"version": "2.0", "generator": "etsplat"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(content.meshes)))}],
        "nodes": [{"mesh": index, "name": mesh["name"], **placed} for index, mesh in enumerate(content.meshes)],
        "meshes": content.meshes,
        "materials": content.materials,
        "buffers": [{"byteLength": content.size}],
        "bufferViews": content.views,
        "accessors": content.accessors,
    }
    if content.images:
        document |= {"images": content.images, "textures": content.textures, "samplers": content.samplers}
    if surface.record:
        document["asset"]["extras"] = {"etsplat": dict(surface.record)}
    if any("extensions" in material for material in content.materials):
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(content.data)
    with open(path, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(data), b"BIN\0") + data)


def _node(surface: Surface) -> dict[str, Any]:
    """Where a node lies; nothing at the origin."""
    if surface.offset is None:
        return {}
    x, y, z = surface.offset.tolist()
    if not surface.z_up:
        return {"translation": [x, y, z]}
    half = math.sqrt(0.5)
    return {"translation": [x, z, -y], "rotation": [-half, 0, 0, half]}


class _Content:
    """Meshes with their materials, and the arrays that they are of."""

    def __init__(self) -> None:
        self.meshes: list[dict[str, Any]] = []
        self.materials: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []
        self.textures: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        self.data: list[bytes] = []
        self.size = 0

    def add(self, name: str, surface: Surface, material: Callable[[str], str], *, double_sided: bool) -> None:
        """Append a mesh; `material` names the material of an alpha mode."""
        relief = None if surface.texture is None else surface.texture.relief
        about = {}
        if surface.texture is not None:
            surface, about = _by_vertex(surface, surface.texture)
        vertices, colors = surface.vertices, surface.vertex_colors
        attributes = {"POSITION": self._array("VEC3", vertices.astype("<f4"))}
        self.accessors[-1] |= {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
        if colors is not None:
            linear = np.ones((len(colors), 4))
            linear[:, : colors.shape[1]] = np.hstack([linear_from_srgb(colors[:, :3]), colors[:, 3:]])
            attributes["COLOR_0"] = self._array("VEC4", linear.astype("<f4"))
        for attribute, values in about.items():
            attributes[attribute] = self._array(f"VEC{values.shape[1]}", values)
        pictures = {}
        if surface.texture is not None:
            sampler = self._sampler(surface.texture)
            pictures["baseColorTexture"] = self._picture(surface.texture.pixels, sampler)
            if relief is not None:
                pictures["normalTexture"] = self._picture(relief.pixels, sampler)
        primitives = []
        for part, mode in _parts(surface):
            indices = self._array("SCALAR", part.astype("<u4").reshape(-1))
            primitives.append(
                {"attributes": attributes, "indices": indices, "mode": 4, "material": len(self.materials)}
            )
            unlit = (colors is not None or surface.texture is not None) and relief is None
            made = _gltf_material(material(mode), mode, unlit=unlit, double_sided=double_sided)
            for role, picture in pictures.items():
                owner = made["pbrMetallicRoughness"] if role == "baseColorTexture" else made
                owner[role] = {"index": picture}
            self.materials.append(made)
        self.meshes.append({"primitives": primitives, "name": name})

    def _array(self, kind: str, array: np.ndarray) -> int:
        """Append an array; the number of its accessor."""
        component, target = (5125, 34963) if kind == "SCALAR" else (5126, 34962)
        view = self._view(array.tobytes(), target=target)
        self.accessors.append({"bufferView": view, "count": len(array), "componentType": component, "type": kind})
        return len(self.accessors) - 1

    def _sampler(self, texture: SurfaceTexture) -> int:
        """Append how a texture is read, which ends at its border; its number."""
        smaller = _LINEAR_MIPMAP_LINEAR if texture.mipmaps else _LINEAR
        edge = {"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}
        self.samplers.append({"magFilter": _LINEAR, "minFilter": smaller, **edge})
        return len(self.samplers) - 1

    def _picture(self, pixels: np.ndarray, sampler: int) -> int:
        """Append a picture as a texture; its number."""
        self.images.append({"bufferView": self._view(encode_png(pixels)), "mimeType": "image/png"})
        self.textures.append({"sampler": sampler, "source": len(self.images) - 1})
        return len(self.textures) - 1

    def _view(self, data: bytes, **more: int) -> int:
        """Append bytes, from a multiple of 4 on; the number of their view."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data), **more})
        data += bytes(-len(data) % 4)
        self.data.append(data)
        self.size += len(data)
        return len(self.views) - 1


def _by_vertex(surface: Surface, texture: SurfaceTexture) -> tuple[Surface, dict[str, np.ndarray]]:
    """The same with vertices apart where what is known of their corners is, and that by the names of attributes."""
    known = {"TEXCOORD_0": texture.corner_uvs}
    if texture.relief is not None:
        known |= {"NORMAL": texture.relief.normals, "TANGENT": texture.relief.tangents}
    corners = surface.faces.reshape(-1)
    rows = {name: values.reshape(len(corners), -1).astype("<f4") for name, values in known.items()}
    keys = np.column_stack([corners, *(values.view("<u4") for values in rows.values())])
    _, first, faces = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    colors = None if surface.vertex_colors is None else surface.vertex_colors[corners[first]]
    apart = replace(
        surface, vertices=surface.vertices[corners[first]], faces=faces.reshape(-1, 3), vertex_colors=colors
    )
    return apart, {name: values[first] for name, values in rows.items()}


def _parts(surface: Surface) -> list[tuple[np.ndarray, str]]:
    """Faces that are opaque, and those that blend, with their alpha mode."""
    faces, colors = surface.faces, surface.vertex_colors
    if colors is None or colors.shape[1] < 4:
        return [(faces, "OPAQUE")]
    solid = (colors[:, 3] >= OPAQUE_ALPHA)[faces].all(axis=1)
    return [(part, mode) for part, mode in ((faces[solid], "OPAQUE"), (faces[~solid], "BLEND")) if len(part)]


def _gltf_material(name: str, mode: str, *, unlit: bool, double_sided: bool) -> dict[str, Any]:
    """Colours already hold the scene's light, so a viewer must not light them again, unless that is asked for."""
    material: dict[str, Any] = {
        "name": name,
        "doubleSided": double_sided,
        "alphaMode": mode,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    }
    return {**material, "extensions": {"KHR_materials_unlit": {}}} if unlit else material
