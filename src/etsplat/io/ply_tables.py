"""The vertex table of a PLY file: what point clouds and Gaussian scenes are stored as."""

from pathlib import Path

import numpy as np

from etsplat.core.errors import InputError

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply_table(path: Path | str) -> np.ndarray:
    """The element `vertex` of a PLY file, ASCII or binary.

    Returns:
        A structured array with a field for each property, in the file's types.

    Raises:
        InputError: the file is missing, cut short, not PLY, or its vertices are not a plain table at its start.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"points {path}: no such file; check the path")
    data = path.read_bytes()
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputError(f"points {path}: not a PLY file; export it again")
    start = data.find(b"\n", end) + 1
    order, count, names = _header(path, data[:end].decode("ascii", errors="replace").splitlines())
    dtype = np.dtype([(name, order + kind) for name, kind in names])
    if order == "=":
        return _ascii_table(path, data[start:], dtype, count)
    if len(data) - start < count * dtype.itemsize:
        raise InputError(f"points {path}: the file is cut short; export it again")
    return np.frombuffer(data, dtype, count, start)


def write_ply_table(table: np.ndarray) -> bytes:
    """A binary PLY file whose element `vertex` is the structured array."""
    names = {np.dtype(kind): name for name, kind in _TYPES.items() if not name[-1].isdigit()}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    fields = [(name, table.dtype[name]) for name in table.dtype.names or ()]
    lines += [f"property {names[kind]} {name}" for name, kind in fields] + ["end_header", ""]
    little = table.astype([(name, kind.newbyteorder("<")) for name, kind in fields])
    return "\n".join(lines).encode() + little.tobytes()


def _header(path: Path, lines: list[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """Byte order, number of vertices, and names with types of their properties."""
    order, element, count, names = "", "", 0, []
    for line in lines:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _FORMATS.get(words[1], "")
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1] if element in ("", "vertex") else element
            if element == "vertex" and not names:
                count = int(words[2]) if words[2].isdigit() else 0
            elif element == "vertex":
                break
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise InputError(f"points {path}: unknown property `{line.strip()[:40]}`; export it again")
            names.append((words[2], _TYPES[words[1]]))
    if not order or element != "vertex" or not names:
        raise InputError(f"points {path}: the PLY file does not start with vertices; export it again")
    return order, count, names


def _ascii_table(path: Path, text: bytes, dtype: np.dtype, count: int) -> np.ndarray:
    rows = text.decode("ascii", errors="replace").splitlines()[:count]
    try:
        values = np.array([[float(word) for word in row.split()] for row in rows], dtype=np.float64)
        if values.shape != (count, len(dtype.names or ())):
            raise ValueError("rows are missing or of different lengths")
    except ValueError as error:
        raise InputError(f"points {path}: the vertices cannot be read ({error}); export it again") from error
    table = np.empty(count, dtype)
    for column, name in enumerate(dtype.names or ()):
        table[name] = values[:, column]
    return table
