"""What a binary glTF file must be, checked on its bytes: the rules of the specification that our files can break."""

import io
import json
import struct
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from etsplat.io._gltf import join_gltf, split_gltf

needs_meshopt = pytest.mark.skipif(find_spec("meshoptimizer") is None, reason="meshoptimizer is not installed")

_TYPES = {5120: "i1", 5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_ATTRIBUTES = {"POSITION": "VEC3", "NORMAL": "VEC3", "TANGENT": "VEC4", "TEXCOORD_0": "VEC2", "COLOR_0": "VEC4"}
_ARRAYS, _INDICES = 34962, 34963
_WHOLE = {"POSITION": "<u2", "NORMAL": "i1", "TANGENT": "i1"}
"""What KHR_mesh_quantization adds, as far as it is written."""
_MESHOPT, _WEBP = "EXT_meshopt_compression", "EXT_texture_webp"


def read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document and the buffer of a file whose header and two chunks are as they must be."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert (kind, size % 4) == (b"JSON", 0)
    text, rest = data[20 : 20 + size], data[20 + size :]
    size, kind = struct.unpack("<I4s", rest[:8])
    assert (kind, size % 4, size) == (b"BIN\0", 0, len(rest) - 8)
    return json.loads(text.decode("utf-8"), parse_constant=_refuse), rest[8:]


def change_gltf(path: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """Edits the document of a file, GLB or glTF, and returns its path."""
    data = path.read_bytes()
    document, _ = split_gltf(data)
    edit(document)
    path.write_bytes(join_gltf(data, document))
    return path


def array_of(document: dict[str, Any], buffer: bytes, number: int) -> np.ndarray:
    """What an accessor holds, a row for each element, as it is stored."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
    data = _view_bytes(buffer, view)
    assert len(data) == view["byteLength"]
    stride = view.get("byteStride", width * kind.itemsize)
    assert stride % (4 if view["target"] == _ARRAYS else 1) == 0
    assert stride >= width * kind.itemsize
    assert accessor["count"] * stride <= len(data)
    return np.ndarray((accessor["count"], width), kind, data, 0, (stride, kind.itemsize))


def values_of(document: dict[str, Any], buffer: bytes, number: int) -> np.ndarray:
    """What an accessor means: that in [-1, 1] where its whole numbers are so."""
    found, accessor = array_of(document, buffer, number), document["accessors"][number]
    if not accessor.get("normalized"):
        return found
    return np.maximum(found / np.iinfo(found.dtype).max, -1)


def _view_bytes(buffer: bytes, view: dict[str, Any]) -> bytes:
    packed = view.get("extensions", {}).get(_MESHOPT)
    place = view if packed is None else packed
    data = buffer[place["byteOffset"] : place["byteOffset"] + place["byteLength"]]
    if packed is None:
        return data
    import meshoptimizer

    stride, count = packed["byteStride"], packed["count"]
    if packed["mode"] == "TRIANGLES":
        assert view["target"] == _INDICES
        return meshoptimizer.decode_index_buffer(count, 4, data).astype(f"<u{stride}").tobytes()
    assert packed["mode"] == "ATTRIBUTES"
    assert view["byteStride"] == stride
    assert data[0] == 0xA0, "the extension knows no other version"
    return meshoptimizer.decode_vertex_buffer(count, stride, data, np.dtype(f"V{stride}")).tobytes()


def check_glb(path: Path) -> dict[str, Any]:
    """The document of a file in which everything fits together; AssertionError where something does not."""
    document, buffer = read_glb(path)
    assert document["asset"]["version"] == "2.0"
    sizes = [entry["byteLength"] for entry in document["buffers"]]
    assert sizes[0] == len(buffer)
    fallback = {"extensions": {_MESHOPT: {"fallback": True}}}
    assert [entry | fallback == entry for entry in document["buffers"][1:]] == [True] * (len(sizes) - 1)
    ends = [0] * len(sizes)
    stored = [view["extensions"][_MESHOPT] for view in document["bufferViews"] if "extensions" in view]
    for view in sorted([*document["bufferViews"], *stored], key=lambda view: view["byteOffset"]):
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] >= ends[view["buffer"]], "views overlap"
        ends[view["buffer"]] = view["byteOffset"] + view["byteLength"]
        assert 0 < view["byteLength"] <= sizes[view["buffer"]] - view["byteOffset"]
    for mesh in document["meshes"]:
        assert mesh["primitives"]
        for primitive in mesh["primitives"]:
            _check_primitive(document, buffer, primitive)
    for image in document.get("images", []):
        view = document["bufferViews"][image["bufferView"]]
        assert "target" not in view
        with Image.open(io.BytesIO(buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])) as picture:
            assert f"image/{picture.format}".lower() == image["mimeType"]
    _check_references(document)
    return document


def _check_primitive(document: dict[str, Any], buffer: bytes, primitive: dict[str, Any]) -> None:
    arrays = {name: values_of(document, buffer, number) for name, number in primitive["attributes"].items()}
    vertices = len(arrays["POSITION"])
    for name, number in primitive["attributes"].items():
        accessor = document["accessors"][number]
        assert accessor["type"] == _ATTRIBUTES[name]
        assert document["bufferViews"][accessor["bufferView"]]["target"] == _ARRAYS
        assert len(arrays[name]) == vertices
        if _TYPES[accessor["componentType"]] != "<f4":
            whole = _WHOLE.get(name, "<u2")
            assert (_TYPES[accessor["componentType"]], accessor.get("normalized", False)) == (whole, name != "POSITION")
        assert np.isfinite(arrays[name]).all()
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == arrays["POSITION"].min(axis=0).tolist()
    assert position["max"] == arrays["POSITION"].max(axis=0).tolist()
    for name in ("NORMAL", "TANGENT"):
        if name in arrays:
            near = 5e-4 if arrays[name].dtype == np.float32 else 0.0068  # half of 1/127 along each axis
            assert np.allclose(np.linalg.norm(arrays[name][:, :3].astype(float), axis=1), 1, atol=near)
    if "TANGENT" in arrays:
        assert np.isin(arrays["TANGENT"][:, 3], (-1, 1)).all()
    if "COLOR_0" in arrays:
        assert ((arrays["COLOR_0"] >= 0) & (arrays["COLOR_0"] <= 1)).all()
    accessor = document["accessors"][primitive["indices"]]
    assert document["bufferViews"][accessor["bufferView"]]["target"] == _INDICES
    indices = array_of(document, buffer, primitive["indices"])
    assert accessor["type"] == "SCALAR"
    assert accessor["componentType"] != 5126
    assert len(indices) % 3 == 0 < len(indices)
    assert indices.max() < min(vertices, 2 ** (8 * indices.itemsize) - 1)


def _check_references(document: dict[str, Any]) -> None:
    """Everything that is named is there, and nothing is there that is not used."""
    used: dict[str, set[int]] = {key: set() for key in ("accessors", "materials", "textures", "images", "samplers")}
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            used["accessors"] |= {primitive["indices"], *primitive["attributes"].values()}
            used["materials"].add(primitive["material"])
            textures = list(_textures(document["materials"][primitive["material"]]))
            used["textures"] |= set(textures)
            assert bool(textures) == ("TEXCOORD_0" in primitive["attributes"])
    for texture in document.get("textures", []):
        used["images"].add(texture.get("extensions", {}).get(_WEBP, texture)["source"])
        used["samplers"].add(texture["sampler"])
    views = [entry["bufferView"] for key in ("accessors", "images") for entry in document.get(key, [])]
    assert sorted(views) == list(range(len(document["bufferViews"])))
    for key, numbers in used.items():
        assert numbers == set(range(len(document.get(key, [])))), key
        assert key not in document or document[key], f"{key} is empty"
    nodes = range(len(document["nodes"]))
    assert [scene["nodes"] for scene in document["scenes"]] == [list(nodes)]
    assert {node["mesh"] for node in document["nodes"]} == set(range(len(document["meshes"])))
    optional = {name for material in document["materials"] for name in material.get("extensions", {})}
    needed = {name for texture in document.get("textures", []) for name in texture.get("extensions", {})}
    needed |= {name for view in document["bufferViews"] for name in view.get("extensions", {})}
    kinds = {
        document["accessors"][primitive["attributes"][name]]["componentType"]
        for mesh in document["meshes"]
        for primitive in mesh["primitives"]
        for name in primitive["attributes"]
        if name in _WHOLE
    }
    needed |= set() if kinds == {5126} else {"KHR_mesh_quantization"}
    for key, expected in (("extensionsUsed", optional | needed), ("extensionsRequired", needed)):
        assert set(document.get(key, [])) == expected
        assert key not in document or document[key]


def _textures(entry: Any) -> Any:
    """Numbers of all textures that a material names."""
    for name, value in entry.items():
        if name.endswith("Texture"):
            yield value["index"]
        elif isinstance(value, dict):
            yield from _textures(value)


def _refuse(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")
