"""PLY files as tables: points, Gaussian scenes, and triangles with numbers of their own."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from etsplat.core.errors import InputError

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
_ALIASES = {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_ALIASES |= {"float32": "f4", "float64": "f8", **_TYPES}
_NAMES = {np.dtype(kind): name for name, kind in _TYPES.items()}
_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

CORNERS = "vertex_indices"
"""The list property of a face: the only kind of list that is read, with three entries each."""


@dataclass(frozen=True)
class _Element:
    """A table of the file: its name, the number of its rows, and (name, type, is a list of three) of its columns."""

    name: str
    count: int
    columns: list[tuple[str, str, bool]]


def read_ply_tables(path: Path | str, elements: tuple[str, ...] = ("vertex",)) -> dict[str, np.ndarray]:
    """Read elements of a PLY file, ASCII or binary, up to the last one asked for.

    Args:
        path: the file.
        elements: which; each must be there.

    Returns:
        For each element a structured array with a field for every property, in the file's types. Corners of faces are
        the field `vertex_indices` of shape (3,).

    Raises:
        InputError: the file is missing, cut short, not PLY, lacks an element, or has lists other than triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"PLY file {path}: no such file; check the path")
    data = path.read_bytes()
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputError(f"PLY file {path}: has no PLY header; export it again")
    start = data.find(b"\n", end) + 1
    order, found = _header(path, data[:end].decode("ascii", errors="replace"))
    missing = [name for name in elements if name not in [element.name for element in found]]
    if missing:
        raise InputError(f"PLY file {path}: has no element {missing[0]}; export it again")
    lines = data[start:].decode("ascii", errors="replace").splitlines() if order == "=" else []
    tables: dict[str, np.ndarray] = {}
    for element in found:
        if all(name in tables for name in elements):
            break
        dtype = np.dtype(_fields(element, order))
        if order == "=":
            table, lines = _ascii_table(path, element, dtype, lines[: element.count]), lines[element.count :]
        else:
            if len(data) - start < element.count * dtype.itemsize:
                raise InputError(f"PLY file {path}: is cut short; export it again")
            table = np.frombuffer(data, dtype, element.count, start)
            start += element.count * dtype.itemsize
        for name in dtype.names or ():
            if name.startswith("#") and not bool((table[name] == 3).all()):
                raise InputError(f"PLY file {path}: has faces with other than three corners; triangulate it")
        tables[element.name] = table
    return {name: tables[name] for name in elements}


@dataclass(frozen=True)
class PlyHeader:
    """What the header of a file says: names of the properties of every element, and the lines of comment."""

    properties: dict[str, list[str]]
    comments: list[str]


def read_ply_header(path: Path | str) -> PlyHeader:
    """Read the header alone.

    Raises:
        InputError: the file is missing or not PLY.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"PLY file {path}: no such file; check the path")
    with open(path, "rb") as file:
        head = file.read(1 << 16)
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise InputError(f"PLY file {path}: has no PLY header; export it again")
    text = head[:end].decode("ascii", errors="replace")
    elements = _header(path, text)[1]
    comments = [line.removeprefix("comment ").strip() for line in text.splitlines() if line.startswith("comment ")]
    return PlyHeader({element.name: [name for name, _, _ in element.columns] for element in elements}, comments)


def encode_ply(tables: Mapping[str, np.ndarray], comment: str | None = None) -> bytes:
    """A binary PLY file with an element for each structured array; fields of shape (3,) become lists of corners."""
    header, body = ["ply", "format binary_little_endian 1.0"], []
    header += [f"comment {comment}"] if comment else []
    for element, table in tables.items():
        header.append(f"element {element} {len(table)}")
        fields: list[tuple] = []
        for name in table.dtype.names or ():
            kind = table.dtype[name]
            if kind.shape == (3,):
                header.append(f"property list uchar {_NAMES[kind.base]} {name}")
                fields += [(f"#{name}", "u1"), (name, kind.base.newbyteorder("<"), (3,))]
            else:
                header.append(f"property {_NAMES[kind]} {name}")
                fields.append((name, kind.newbyteorder("<")))
        packed = np.empty(len(table), fields)
        for name in packed.dtype.names or ():
            packed[name] = 3 if name.startswith("#") else table[name]
        body.append(packed.tobytes())
    return "\n".join([*header, "end_header", ""]).encode() + b"".join(body)


def _header(path: Path, text: str) -> tuple[str, list[_Element]]:
    order, elements = "", []
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _FORMATS.get(words[1], "")
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1].columns.append(_column(path, line, words))
    if not order or not elements:
        raise InputError(f"PLY file {path}: the header names no format or no element; export it again")
    return order, elements


def _column(path: Path, line: str, words: list[str]) -> tuple[str, str, bool]:
    if len(words) == 3 and words[1] in _ALIASES:
        return words[2], _ALIASES[words[1]], False
    corners = len(words) == 5 and words[1] == "list" and re.fullmatch(r"vertex_ind(ex|ices)", words[4])
    if corners and words[2] in ("uchar", "uint8") and words[3] in _ALIASES:
        return CORNERS, _ALIASES[words[3]], True
    raise InputError(f"PLY file {path}: cannot read `{line.strip()[:50]}`; export it again")


def _fields(element: _Element, order: str) -> list[tuple]:
    fields: list[tuple] = []
    for name, kind, corners in element.columns:
        fields += [(f"#{name}", "u1"), (name, order + kind, (3,))] if corners else [(name, order + kind)]
    return fields


def _ascii_table(path: Path, element: _Element, dtype: np.dtype, lines: list[str]) -> np.ndarray:
    widths = [dtype[name].shape[0] if dtype[name].shape else 1 for name in dtype.names or ()]
    try:
        values = np.array([[float(word) for word in line.split()] for line in lines], dtype=np.float64)
        if values.shape != (element.count, sum(widths)):
            raise ValueError("rows are missing or of different lengths")
    except ValueError as error:
        raise InputError(f"PLY file {path}: {element.name} cannot be read ({error}); export it again") from error
    table, column = np.empty(element.count, dtype), 0
    for name, width in zip(dtype.names or (), widths, strict=True):
        table[name] = values[:, column] if width == 1 else values[:, column : column + width]
        column += width
    return table
