"""glTF files as a document and arrays; those of quantised and compressed ones as any reader takes them."""

import base64
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from etsplat.core.errors import InputError
from etsplat.io import meshopt
from etsplat.io.paths import path_within

_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_DRACO, _INSTANCING = "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing"
_FAN = 6
"""Mode of primitives that share their first corner; the readers of the others pass over them."""

_SHARING = 4
"""Accessors may share bytes; together they have no more than this many times those that there are."""


def local_file(folder: Path, name: str, source: Path) -> Path:
    """Where a picture or a buffer is that a file names.

    Raises:
        InputError: it is in the network, leads out of the folder, or is not there.
    """
    if "://" in name:
        raise InputError(f"{source}: {name[:80]!r} is in the network; copy the picture beside it and name it there")
    path = path_within(folder, name.replace("\\", "/"), source)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{source}: {name!r} leads out of {folder}; copy the picture there")
    return path


def split_gltf(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk of GLB or glTF, which is empty where there is none."""
    if not data.startswith(b"glTF"):
        return json.loads(data), b""
    end = 20 + int.from_bytes(data[12:16], "little")
    size = int.from_bytes(data[end : end + 4], "little")
    return json.loads(data[20:end]), data[end + 8 : end + 8 + size]


def join_gltf(data: bytes, document: dict[str, Any]) -> bytes:
    """The same file with another document."""
    text = json.dumps(document).encode()
    if not data.startswith(b"glTF"):
        return text
    text += b" " * (-len(text) % 4)
    rest = data[20 + int.from_bytes(data[12:16], "little") :]
    total = 20 + len(text) + len(rest)
    return data[:8] + total.to_bytes(4, "little") + len(text).to_bytes(4, "little") + b"JSON" + text + rest


def view_bytes(path: Path, document: dict[str, Any], binary: bytes, view: dict[str, Any]) -> bytes:
    """What is in a view, or in the place that an extension names, of the file, of another, or of the document."""
    uri = document["buffers"][view["buffer"]].get("uri")
    if uri is None:
        data = binary
    elif uri.startswith("data:"):
        data = base64.b64decode(uri.partition(",")[2])
    else:
        data = local_file(path.parent, unquote(uri), path).read_bytes()
    start = view.get("byteOffset", 0)
    return data[start : start + view["byteLength"]]


def check_gltf(path: Path) -> bytes:
    """The file. Raises what damage leads to, and ValueError where arrays are larger than the files."""
    data = path.read_bytes()
    room, at = len(data), 12
    if data.startswith(b"glTF"):
        while at < min(room, int.from_bytes(data[8:12], "little")):
            at += 8 + int.from_bytes(data[at : at + 4], "little")
        if at > room + 8:  # of what follows the last chunk only a part may be there
            raise ValueError(f"chunks of {at} bytes in {room}")
    document = split_gltf(data)[0]
    for uri in [buffer["uri"] for buffer in document.get("buffers", []) if "uri" in buffer]:
        if not uri.startswith("data:"):
            room += path_within(path.parent, uri, path).stat().st_size
    stored = [said for view in document.get("bufferViews", []) if (said := _packed(view)) is not None]
    if sum(said["byteLength"] for said in stored) > room:
        raise ValueError(f"compressed arrays beyond the {room} bytes that there are")
    room += sum(meshopt.checked_size(said) for said in stored)
    claimed = 0
    for accessor in document.get("accessors", []):
        if accessor["count"] < 0:
            raise ValueError(f"an array of {accessor['count']} elements")
        size = np.dtype(_KINDS[accessor["componentType"]]).itemsize
        claimed += accessor["count"] * _COMPONENTS[accessor["type"]] * size
    if claimed > _SHARING * room:
        raise ValueError(f"arrays of {claimed} bytes in {room}")
    return data


def is_compressed(document: dict[str, Any]) -> bool:
    """Whether arrays have to be decoded."""
    return any(_packed(view) is not None for view in document.get("bufferViews", []))


def refuse_unread(path: Path, document: dict[str, Any]) -> None:
    """Raise InputError for extensions without which another surface would be read, or none."""
    primitives = [primitive for mesh in document.get("meshes", []) for primitive in mesh["primitives"]]
    if not document.get("scenes"):
        raise InputError(f"mesh {path}: has no scene, which says what of it is there; export it again with one")
    if any(primitive.get("mode") == _FAN for primitive in primitives):
        raise InputError(f"mesh {path}: has fans of triangles, which are not read; export it as triangles")
    if any(_DRACO in primitive.get("extensions", {}) for primitive in primitives):
        raise InputError(
            f"mesh {path}: is compressed by Draco ({_DRACO}), which is not read; export it without compression,"
            " or with EXT_meshopt_compression"
        )
    if any(_INSTANCING in node.get("extensions", {}) for node in document.get("nodes", [])):
        raise InputError(
            f"mesh {path}: places copies of its meshes by {_INSTANCING}, which is not read; export each copy as a node"
        )


COLOR = "_ETSPLAT_COLOR"
"""Attribute of vertices whose colours are kept as they are; of those of the usual name trimesh makes 8 bits."""


def keep_colors(document: dict[str, Any]) -> bool:
    """Give colours of vertices a name under which their numbers are read; whether there are any."""
    attributes = [each["attributes"] for mesh in document.get("meshes", []) for each in mesh["primitives"]]
    colored = [each for each in attributes if "COLOR_0" in each]
    for each in colored:
        each[COLOR] = each["COLOR_0"]
    return bool(colored)


def fractions(values: np.ndarray) -> np.ndarray:
    """Numbers of vertices: of whole ones, which count from 0 to the highest that there is, fractions of it."""
    return values / np.iinfo(values.dtype).max if values.dtype.kind == "u" else values.astype(np.float64)


def unmoved_note(path: Path, document: dict[str, Any]) -> list[str]:
    """A note on what would move vertices, and is left out; nothing without."""
    meshes = [primitive for mesh in document.get("meshes", []) for primitive in mesh["primitives"]]
    what = {
        "skins": any("skin" in node for node in document.get("nodes", [])),
        "morph targets": any(primitive.get("targets") for primitive in meshes),
    }
    named = " and ".join(name for name, there in what.items() if there)
    return [f"{path.name}: {named} are ignored; it is as it is without them, not posed"] if named else []


def unpack(path: Path, document: dict[str, Any], binary: bytes) -> bool:
    """Change a document so that its arrays are neither quantised nor compressed; whether any was.

    They come to be in a buffer within the document, those of vertices in 32-bit floats.

    Raises:
        InputError: the package that decodes is missing.
        ValueError: an array is damaged; other errors where the document is.
    """
    rows = {number: _accessor(path, document, binary, number) for number in sorted(_to_unpack(document))}
    if not rows:
        return False
    data, at = [], 0
    views, buffer = document["bufferViews"], len(document["buffers"])
    for number, array in rows.items():
        accessor = document["accessors"][number]
        views.append({"buffer": buffer, "byteOffset": at, "byteLength": array.nbytes})
        for name in ("byteOffset", "normalized", "min", "max"):
            accessor.pop(name, None)
        kind = next(kind for kind, name in _KINDS.items() if np.dtype(name) == array.dtype)
        accessor |= {"bufferView": len(views) - 1, "componentType": kind}
        data.append(array.tobytes() + bytes(-array.nbytes % 4))
        at += len(data[-1])
    text = base64.b64encode(b"".join(data)).decode("ascii")
    document["buffers"].append({"byteLength": at, "uri": f"data:application/octet-stream;base64,{text}"})
    _forget_compression(document)
    return True


def _to_unpack(document: dict[str, Any]) -> set[int]:
    """Accessors of which others would make something else: those of whole numbers where there are quantised ones."""
    quantized = "KHR_mesh_quantization" in document.get("extensionsUsed", [])
    packed = {number for number, view in enumerate(document.get("bufferViews", [])) if _packed(view) is not None}
    found = {n for n, accessor in enumerate(document.get("accessors", [])) if accessor.get("bufferView") in packed}
    if quantized:
        for primitive in (each for mesh in document.get("meshes", []) for each in mesh["primitives"]):
            numbers = {number for name, number in primitive["attributes"].items() if not name.startswith("_")}
            found |= {number for number in numbers if document["accessors"][number]["componentType"] != 5126}
    return found


def _accessor(path: Path, document: dict[str, Any], binary: bytes, number: int) -> np.ndarray:
    """(N, C) what an accessor holds; indices as they are, the rest as 32-bit floats."""
    accessor = document["accessors"][number]
    if "sparse" in accessor:
        raise ValueError("an array that is sparse and packed")
    view, kind = document["bufferViews"][accessor["bufferView"]], np.dtype(_KINDS[accessor["componentType"]])
    if (said := _packed(view)) is None:
        data, stride = view_bytes(path, document, binary, view), view.get("byteStride", 0)
    else:
        data, stride = meshopt.decoded(view_bytes(path, document, binary, said), said), said["byteStride"]
    wide, count, start = _COMPONENTS[accessor["type"]], accessor["count"], accessor.get("byteOffset", 0)
    stride = stride or wide * kind.itemsize
    if (
        not start >= 0
        or stride < wide * kind.itemsize
        or start + stride * (count - 1) + wide * kind.itemsize > len(data)
    ):
        raise ValueError(f"an array of {count} rows of {stride} bytes beyond its {len(data)}")
    rows = np.ndarray((count, wide), kind, data, start, (stride, kind.itemsize))
    if accessor["type"] == "SCALAR" and kind.kind == "u":
        return np.ascontiguousarray(rows)
    floats = rows.astype("<f4")
    if accessor.get("normalized") and kind.kind != "f":
        floats = np.maximum(floats / np.float32(np.iinfo(kind).max), np.float32(-1))
    return floats


def _forget_compression(document: dict[str, Any]) -> None:
    """Make views hold what is stored, and buffers nothing that there is not, so that no reader looks for it."""
    for buffer in document["buffers"]:
        if buffer.get("extensions", {}).get(meshopt.EXTENSION, {}).get("fallback") and "uri" not in buffer:
            buffer["uri"] = "data:application/octet-stream;base64,"
    for view in document["bufferViews"]:
        if (said := _packed(view)) is not None:
            view.clear()
            view |= {
                "buffer": said["buffer"],
                "byteOffset": said.get("byteOffset", 0),
                "byteLength": said["byteLength"],
            }
    known = {"KHR_mesh_quantization", meshopt.EXTENSION}
    for name in ("extensionsUsed", "extensionsRequired"):
        document[name] = [each for each in document.get(name, []) if each not in known]


def _packed(view: dict[str, Any]) -> dict[str, Any] | None:
    return view.get("extensions", {}).get(meshopt.EXTENSION)
