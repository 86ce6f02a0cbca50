"""PLY files as tables: points, Gaussian scenes, and triangles with numbers of their own."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

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
_BRIGHTEST = 2
"""Of colours that are no bytes: larger ones are from 0 to 255, others from 0 to 1, and clamped."""

_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16

COLORS = ("red", "green", "blue")
"""The properties that are a colour."""

_OTHER_COLORS = (("r", "g", "b"), tuple(f"diffuse_{name}" for name in COLORS))
"""What other programs call them."""

CORNERS = "vertex_indices"
"""The list property of a face: its three corners."""

PLACES = "texcoord"
"""The other list property that is read: where these three are in a texture, (0, 0) in its lower left corner."""

GREY = 0.5
"""The colour of points without one."""


@dataclass(frozen=True)
class PlyHeader:
    """What the header of a file says.

    Attributes:
        tables: of each element, in their order, the number of rows, and a field for every property; the number of
            corners of a face is in the field `#vertex_indices`.
        comments: lines of text.
        text: whether the tables are text, not binary.
        size: in bytes.
    """

    tables: dict[str, tuple[int, np.dtype]]
    comments: list[str]
    text: bool
    size: int

    def properties(self, element: str) -> set[str]:
        """The names of an element's properties; none if there is no such element."""
        return set(self.tables[element][1].names or ()) if element in self.tables else set()


def type_of(word: str) -> str:
    """How numpy calls a type of PLY.

    Raises:
        KeyError: there is none of this name.
    """
    return _ALIASES[word]


def read_ply_header(path: Path | str) -> PlyHeader:
    """Read the header alone.

    Raises:
        InputError: the file is missing or not PLY, names a property twice, or has lists other than triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"PLY file {path}: no such file; check the path")
    with open(path, "rb") as file:
        head, mark, rest = file.read(_LONGEST_HEADER).partition(b"end_header")
    size = len(head) + len(mark) + len(rest.partition(b"\n")[0]) + 1
    head = _with_usual_colors(head)
    if not head.startswith(b"ply") or not mark:
        raise InputError(f"PLY file {path}: has no PLY header; export it again")
    order, comments = "", []
    counts: dict[str, int] = {}
    fields: list[list[tuple]] = []
    for line in head.decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _FORMATS.get(words[1], "")
        elif words[:1] == ["comment"]:
            comments.append(line.removeprefix("comment ").strip())
        elif words[:1] == ["element"] and len(words) == 3 and re.fullmatch(r"\d{1,15}", words[2]):
            counts[words[1]] = int(words[2])
            fields.append([])
        elif words[:1] == ["property"] and fields and order:
            fields[-1] += _fields(path, order, line)
    if not order or not counts or len(counts) < len(fields) or not all(fields):
        raise InputError(f"PLY file {path}: the header names no format, or no element or property; export it again")
    try:
        tables = {name: (counts[name], np.dtype(kinds)) for name, kinds in zip(counts, fields, strict=True)}
    except ValueError as error:  # a name that comes twice
        raise InputError(f"PLY file {path}: cannot be read ({error}); export it again") from error
    return PlyHeader(tables, comments, order == "=", size)


def with_usual_colors(path: Path, data: bytes | None) -> bytes | None:
    """A PLY file whose colours are called red, green and blue, for readers that know no other names.

    Args:
        path: of the file.
        data: what is read in its place; None for the file itself.

    Returns:
        `data` where they are called so, or there are none.
    """
    if data is None:
        with open(path, "rb") as file:
            head = file.read(_LONGEST_HEADER).partition(b"end_header")[0]
    else:
        head = data[:_LONGEST_HEADER].partition(b"end_header")[0]
    renamed = _with_usual_colors(head)
    return data if renamed == head else renamed + (data or path.read_bytes())[len(head) :]


def _with_usual_colors(head: bytes) -> bytes:
    """A header in which elements without red, green and blue have these where they have their like."""
    elements = re.split(rb"(?m)^(?=element\b)", head)
    for others in _OTHER_COLORS:
        elements = [_renamed(element, dict(zip(others, COLORS, strict=True))) for element in elements]
    return b"".join(elements)


def _renamed(element: bytes, usual: Mapping[str, str]) -> bytes:
    """The lines of an element with other names, if it has all of the old ones and none of the new ones."""
    lines = element.splitlines(keepends=True)
    words = [line.decode("ascii", errors="replace").split() for line in lines]
    names = {line[-1] for line in words if line[:1] == ["property"]}
    if not names.issuperset(usual) or not names.isdisjoint(usual.values()):
        return element
    for at, line in enumerate(words):
        if line[:1] == ["property"] and line[-1] in usual:
            lines[at] = f"{' '.join([*line[:-1], usual[line[-1]]])}\n".encode()
    return b"".join(lines)


def read_ply_comments(path: Path) -> list[str]:
    """The lines of text in the header of a readable file, whatever properties it has."""
    with open(path, "rb") as file:
        head = file.read(_LONGEST_HEADER).partition(b"end_header")[0].decode("ascii", errors="replace")
    return [line.removeprefix("comment ").strip() for line in head.splitlines() if line.startswith("comment ")]


def read_ply_tables(path: Path | str, elements: tuple[str, ...] = ("vertex",)) -> dict[str, np.ndarray]:
    """Read elements of a PLY file, ASCII or binary, up to the last one asked for.

    Args:
        path: the file.
        elements: which; each must be there.

    Returns:
        For each element a structured array with a field for every property, in the file's types. Corners of faces are
        the field `vertex_indices` of shape (3,).

    Raises:
        InputError: as `read_ply_header`; the file is cut short or lacks an element.
    """
    path, header = Path(path), read_ply_header(path)
    data, start = path.read_bytes(), header.size
    missing = [name for name in elements if name not in header.tables]
    if missing:
        raise InputError(f"PLY file {path}: has no element {missing[0]}; export it again")
    lines = data[start:].decode("ascii", errors="replace").splitlines() if header.text else []
    tables: dict[str, np.ndarray] = {}
    for element, (count, dtype) in header.tables.items():
        if all(name in tables for name in elements):
            break
        if header.text:
            tables[element], lines = _text_table(path, element, dtype, lines[:count], count), lines[count:]
        elif len(data) - start < count * dtype.itemsize:
            raise InputError(f"PLY file {path}: is cut short; export it again")
        else:
            tables[element] = np.frombuffer(data, dtype, count, start)
            start += count * dtype.itemsize
        lists = [name for name in dtype.names or () if dtype[name].shape]
        if any((tables[element][f"#{name}"] != dtype[name].shape[0]).any() for name in lists):
            raise InputError(f"PLY file {path}: has faces with other than three corners; triangulate it")
    return {name: tables[name] for name in elements}


def columns(path: Path | str, table: np.ndarray, *names: str) -> Float[Tensor, "N K"]:
    """Properties of a file's table side by side, in float64.

    Raises:
        InputError: the table lacks one.
    """
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise InputError(f"PLY file {path}: lacks the property {missing[0]}; export it again")
    return torch.from_numpy(np.stack([table[name].astype(np.float64) for name in names], axis=1))


def load_points(path: Path | str) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Positions (float64) and colours (float32 in [0, 1]) of a PLY point cloud; grey where the file has no colours.

    Points that are not finite are left out.

    Raises:
        InputError: as `read_ply_tables`, or there are no coordinates.
    """
    table = read_ply_tables(path)["vertex"]
    points = columns(path, table, *"xyz")
    colors = torch.full(points.shape, GREY)
    if set(COLORS) <= set(table.dtype.names or ()):
        colors = columns(path, table, *COLORS).float()
        if table.dtype["red"].kind == "u":
            colors /= np.iinfo(table.dtype["red"]).max
        elif bool((colors > _BRIGHTEST).any()):  # as some programs write what is from 0 to 255
            colors /= 255
    finite = points.isfinite().all(dim=1) & colors.isfinite().all(dim=1)
    return points[finite], colors[finite].clamp(0, 1)


def encode_ply(tables: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> bytes:
    """A binary PLY file with an element for each structured array; fields of shape (K,) become lists, as of corners."""
    header, body = ["ply", "format binary_little_endian 1.0"], []
    header += [f"comment {comment}" for comment in comments]
    for element, table in tables.items():
        header.append(f"element {element} {len(table)}")
        fields: list[tuple] = []
        for name in table.dtype.names or ():
            kind = table.dtype[name]
            header.append(f"property {'list uchar ' if kind.shape else ''}{_NAMES[kind.base]} {name}")
            fields += [(f"#{name}", "u1")] if kind.shape else []
            fields.append((name, kind.base.newbyteorder("<"), kind.shape))
        packed = np.empty(len(table), fields)
        for name in packed.dtype.names or ():
            packed[name] = table.dtype[name[1:]].shape[0] if name.startswith("#") else table[name]
        body.append(packed.tobytes())
    return "\n".join([*header, "end_header", ""]).encode() + b"".join(body)


def _fields(path: Path, order: str, line: str) -> list[tuple]:
    """Of a property, as numpy has them: one, or two of a list of corners or their places."""
    words = line.split()
    if len(words) == 3 and words[1] in _ALIASES:
        return [(words[2], order + _ALIASES[words[1]])]
    if len(words) == 5 and words[1] == "list" and words[2] in ("uchar", "uint8") and words[3] in _ALIASES:
        name = CORNERS if re.fullmatch(r"vertex_ind(ex|ices)", words[4]) else words[4]
        if name in (CORNERS, PLACES):
            return [(f"#{name}", "u1"), (name, order + _ALIASES[words[3]], (3 if name == CORNERS else 6,))]
    raise InputError(f"PLY file {path}: cannot read `{line.strip()[:50]}`; export it again")


def _text_table(path: Path, element: str, dtype: np.dtype, lines: list[str], count: int) -> np.ndarray:
    widths = [dtype[name].shape[0] if dtype[name].shape else 1 for name in dtype.names or ()]
    try:
        values = np.array([[float(word) for word in line.split()] for line in lines], dtype=np.float64)
        if values.shape != (count, sum(widths)) and count:
            raise ValueError("rows are missing or of different lengths")
        blocks = np.split(values.reshape(count, sum(widths)), np.cumsum(widths)[:-1], axis=1)
        table = np.empty(count, dtype)
        for name, block in zip(dtype.names or (), blocks, strict=True):
            kind = dtype[name].base
            if kind.kind in "iu" and not ((block >= np.iinfo(kind).min) & (block <= np.iinfo(kind).max)).all():
                raise ValueError(f"{name} is beyond its type")
            table[name] = block.reshape(table[name].shape)
    except ValueError as error:
        raise InputError(f"PLY file {path}: {element} cannot be read ({error}); export it again") from error
    return table
