"""Arrays as glTF's EXT_meshopt_compression stores them; the codec is that of the package meshoptimizer."""

from typing import Any

import numpy as np

from etsplat.core.errors import InputError

EXTENSION = "EXT_meshopt_compression"

_TRIANGLES, _ATTRIBUTES, _INDICES = "TRIANGLES", "ATTRIBUTES", "INDICES"
_FILTERS = {"OCTAHEDRAL": "decode_filter_oct", "QUATERNION": "decode_filter_quat", "EXPONENTIAL": "decode_filter_exp"}
_INDEX_BYTES, _ROW_BYTES = (2, 4), range(4, 257, 4)
_STRIDES = {"NONE": _ROW_BYTES, "OCTAHEDRAL": (4, 8), "QUATERNION": (8,), "EXPONENTIAL": _ROW_BYTES}
"""Of rows, by their filter; the package writes beyond its memory where others are asked for."""

_DENSEST, _TAIL = 64, 4096
"""A byte of what is stored holds at most so many, and what is at an end no more than these."""


def load_meshopt() -> Any:
    """The package; InputError, which says how to install it, where it is missing."""
    try:
        import meshoptimizer
    except ImportError as error:
        raise InputError("compressed glTF needs meshoptimizer: pip install 'etsplat[compress]'") from error
    return meshoptimizer


def in_drawing_order(parts: list[np.ndarray], count: int) -> tuple[list[np.ndarray], np.ndarray]:
    """The same triangles in an order in which neighbours follow each other, which is what compresses.

    Args:
        parts: (F, 3) each, indices into the same vertices.
        count: of vertices.

    Returns:
        The parts, with indices into the vertices in their new order; and the numbers of these, of those that are used.
    """
    package, ordered = load_meshopt(), []
    for part in parts:
        before = np.ascontiguousarray(part, dtype=np.uint32).reshape(-1)
        after = np.empty_like(before)
        package.optimize_vertex_cache(after, before, len(before), count)
        ordered.append(after)
    corners = np.concatenate(ordered)
    used, first = np.unique(corners, return_index=True)
    rows = used[np.argsort(first)].astype(np.int64)
    rank = np.zeros(count, dtype=np.uint32)
    rank[rows] = np.arange(len(rows), dtype=np.uint32)
    return [rank[each].reshape(-1, 3) for each in ordered], rows


def encoded_indices(indices: np.ndarray, vertices: int) -> tuple[bytes, dict[str, Any]]:
    """Triangles, (3 F,) of two or four bytes an index, and what the extension says of them. Corners may be turned."""
    package = load_meshopt()
    package.encode_index_version(1)
    data = package.encode_index_buffer(indices, len(indices), vertices)
    return data, {"byteStride": indices.itemsize, "count": len(indices), "mode": _TRIANGLES}


def encoded_rows(rows: np.ndarray) -> tuple[bytes, dict[str, Any]]:
    """(N, C) of a multiple of four bytes a row, and what the extension says of them."""
    package = load_meshopt()
    package.encode_vertex_version(0)  # the extension has no other
    stride = rows.itemsize * rows.shape[1]
    data = package.encode_vertex_buffer(rows, len(rows), stride)
    return data, {"byteStride": stride, "count": len(rows), "mode": _ATTRIBUTES}


def checked_size(said: dict[str, Any]) -> int:
    """Bytes that a view has when it is decoded.

    Raises:
        ValueError: no such view, or one that claims to hold more than it can.
    """
    stride, count, stored = said["byteStride"], said["count"], said["byteLength"]
    mode, kind = said["mode"], said.get("filter", "NONE")
    if mode not in (_TRIANGLES, _ATTRIBUTES, _INDICES) or kind not in _STRIDES:
        raise ValueError(f"{EXTENSION}: mode {mode!r}, filter {kind!r}")
    strides = _STRIDES[kind] if mode == _ATTRIBUTES else _INDEX_BYTES
    whole = all(type(value) is int and value > 0 for value in (stride, count, stored))
    if not whole or stride not in strides or (mode == _TRIANGLES and count % 3):
        raise ValueError(f"{EXTENSION}: {count!r} rows of {stride!r} bytes in {stored!r}")
    if count * stride > _DENSEST * stored + _TAIL:
        raise ValueError(f"{EXTENSION}: {count * stride} bytes in {stored}")
    return count * stride


def decoded(data: bytes, said: dict[str, Any]) -> bytes:
    """What a view of a glTF document holds, of the bytes that are stored and what the extension says of them.

    Raises:
        InputError: the package is missing.
        ValueError: damaged.
        RuntimeError: so.
    """
    package, size = load_meshopt(), checked_size(said)
    stride, count = said["byteStride"], said["count"]
    if said["mode"] == _ATTRIBUTES:
        found = package.decode_vertex_buffer(count, stride, data, np.dtype(f"V{stride}"))
        if (kind := said.get("filter", "NONE")) != "NONE":
            found = getattr(package, _FILTERS[kind])(found, count, stride)
        return found.tobytes()
    decode = package.decode_index_buffer if said["mode"] == _TRIANGLES else package.decode_index_sequence
    found = decode(count, 4, data).astype(f"<u{stride}").tobytes()
    assert len(found) == size
    return found
