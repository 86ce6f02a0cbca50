"""For Blender, game engines and the web (Unity with the package com.unity.cloud.gltfast)."""

import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from etsplat.io.images import encode_png, encode_webp
from etsplat.io.meshopt import in_drawing_order
from etsplat.io.srgb import linear_from_srgb
from etsplat.io.writers import Compression, Content, Surface, SurfaceTexture
from etsplat.io.writers._glb_arrays import Arrays, Grid

HOLDS: frozenset[Content] = frozenset(
    {"vertex_colors", "texture", "alpha", "objects", "normals", "offset", "compressed"}
)

_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071
_WEBP = "EXT_texture_webp"

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

    Quantised (`compress`), positions are whole numbers of 16 bits on a grid of each node's own, which its scale and
    translation place; what else vertices have, 16 bits, normals and tangents 8. Compressed, triangles and vertices are
    in another order too. Programs that know neither extension refuse such files, as they do those with WebP.
    """
    content = _Content(surface.compress)
    content.add(surface.name, surface, lambda mode: mode.lower(), double_sided=True)
    if surface.sky is not None:
        solid = surface.sky.vertex_colors
        solid = None if solid is None else solid[:, :3]  # nothing is behind it to blend with
        content.add("sky", replace(surface.sky, vertex_colors=solid), lambda mode: "sky", double_sided=False)
    document = {
        "asset": {"version": "2.0", "generator": "etsplat"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(content.meshes)))}],
        "nodes": [
            {"mesh": index, "name": mesh["name"], **_node(surface, grid)}
            for index, (mesh, grid) in enumerate(zip(content.meshes, content.grids, strict=True))
        ],
        "meshes": content.meshes,
        "materials": content.materials,
        **content.arrays.document(),
    }
    if content.images:
        document |= {"images": content.images, "textures": content.textures, "samplers": content.samplers}
    if surface.record:
        document["asset"]["extras"] = {"etsplat": dict(surface.record)}
    needed, unlit = content.extensions(), any("extensions" in material for material in content.materials)
    if needed or unlit:
        document["extensionsUsed"] = (["KHR_materials_unlit"] if unlit else []) + needed
    if needed:
        document["extensionsRequired"] = needed
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(content.arrays.data)
    with open(path, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(data), b"BIN\0") + data)


def _node(surface: Surface, grid: Grid | None) -> dict[str, Any]:
    """Where a node lies; nothing at the origin."""
    x, y, z = (0.0, 0.0, 0.0) if grid is None else grid.origin.tolist()
    placed: dict[str, Any] = {} if grid is None else {"scale": [grid.step] * 3}
    if surface.offset is None:
        return placed if grid is None else {"translation": [x, y, z], **placed}
    x, y, z = (x + surface.offset[0], y + surface.offset[1], z + surface.offset[2])
    if not surface.z_up:
        return {"translation": [float(x), float(y), float(z)], **placed}
    half = math.sqrt(0.5)
    return {"translation": [float(x), float(z), -float(y)], "rotation": [-half, 0, 0, half], **placed}


class _Content:
    """Meshes with their materials, and the arrays that they are of."""

    def __init__(self, compress: Compression) -> None:
        self.arrays = Arrays(compress)
        self.meshes: list[dict[str, Any]] = []
        self.grids: list[Grid | None] = []
        self.materials: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []
        self.textures: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []

    def add(self, name: str, surface: Surface, material: Callable[[str], str], *, double_sided: bool) -> None:
        """Append a mesh; `material` names the material of an alpha mode."""
        relief = None if surface.texture is None else surface.texture.relief
        about = {}
        if surface.texture is not None:
            surface, about = _by_vertex(surface, surface.texture)
        parts = _parts(surface)
        values = {"POSITION": surface.vertices, **about}
        if (colors := surface.vertex_colors) is not None:
            linear = np.ones((len(colors), 4))
            linear[:, : colors.shape[1]] = np.hstack([linear_from_srgb(colors[:, :3]), colors[:, 3:]])
            values["COLOR_0"] = linear
        if self.arrays.compress == "meshopt":
            faces, rows = in_drawing_order([part for part, _ in parts], len(surface.vertices))
            parts = list(zip(faces, (mode for _, mode in parts), strict=True))
            values = {attribute: array[rows] for attribute, array in values.items()}
        grid = Grid.around(values["POSITION"]) if self.arrays.quantized else None
        if grid is not None:
            values["POSITION"] = grid.numbers(values["POSITION"])
        attributes = {attribute: self.arrays.attribute(attribute, array) for attribute, array in values.items()}
        pictures = {} if surface.texture is None else self._pictures(surface.texture)
        primitives = []
        for part, mode in parts:
            indices = self.arrays.indices(part, len(values["POSITION"]))
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
        self.grids.append(grid)

    def extensions(self) -> list[str]:
        """Without which the file cannot be read."""
        webp = any("extensions" in texture for texture in self.textures)
        return self.arrays.extensions() + ([_WEBP] if webp else [])

    def _pictures(self, texture: SurfaceTexture) -> dict[str, int]:
        """Append the pictures of a material, all read alike, which end at their borders; the numbers by their roles."""
        smaller = _LINEAR_MIPMAP_LINEAR if texture.mipmaps else _LINEAR
        edge = {"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}
        self.samplers.append({"magFilter": _LINEAR, "minFilter": smaller, **edge})
        webp = texture.kind == "webp"
        found = {"baseColorTexture": self._picture(texture.pixels, webp=webp, lossy=True)}
        if texture.relief is not None:
            found["normalTexture"] = self._picture(texture.relief.pixels, webp=webp, lossy=False)
            if texture.relief.occlusion is not None:
                found["occlusionTexture"] = self._picture(texture.relief.occlusion, webp=webp, lossy=True)
        return found

    def _picture(self, pixels: np.ndarray, *, webp: bool, lossy: bool) -> int:
        """Append a picture as a texture; its number."""
        data = encode_webp(pixels, lossy=lossy) if webp else encode_png(pixels)
        self.images.append({"bufferView": self.arrays.view(data), "mimeType": "image/webp" if webp else "image/png"})
        source = {"source": len(self.images) - 1}
        self.textures.append(
            {"sampler": len(self.samplers) - 1, **({"extensions": {_WEBP: source}} if webp else source)}
        )
        return len(self.textures) - 1


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
