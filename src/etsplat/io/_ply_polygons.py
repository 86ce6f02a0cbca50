"""PLY files with polygons, or strips of triangles, rewritten for readers that know triangles alone."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from etsplat.core.errors import InputError
from etsplat.io._polygons import cut_concave
from etsplat.io.ply_tables import CORNERS, encode_ply, type_of

_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_CORNER_NAMES = ("vertex_indices", "vertex_index")

_STRIPS = "tristrips"
"""The element that some scans have in the place of faces: lists of corners, of which each three in turn are a triangle,
every other one the other way round. After -1 another strip begins."""

Take = Callable[[str, int], tuple[Any, ...]]
"""The next so many numbers of a type in a file."""


@dataclass
class _Element:
    """A table of the file: of each property its name, its type, and the type of its length if it is a list."""

    name: str
    rows: int
    properties: list[tuple[str, str, str | None]]

    def numbers(self, order: str = "<") -> list[tuple[str, str]]:
        """Fields of a row as numpy has them, without its lists."""
        return [(name, order + kind) for name, kind, length in self.properties if length is None]


def with_triangles(path: Path) -> bytes | None:
    """A PLY file of the same vertices and faces, these cut into triangles, which have their other numbers.

    Returns:
        A binary file; None where all faces are triangles, and where the file cannot be read here.

    Raises:
        InputError: a face has fewer than three corners.
    """
    data = path.read_bytes()
    try:
        order, elements, start = _header(data)
        faces = next(element for element in elements if element.name in ("face", _STRIPS))
        before = elements[: elements.index(faces)]
        name, _, length = faces.properties[0]
        if name not in _CORNER_NAMES or length is None or any(kind[2] for each in before for kind in each.properties):
            return None
        words, strips = [] if order else data[start:].split(), faces.name == _STRIPS
        told = _are_triangles(data, start, order, before, faces) if order else _are_triangles_in(words, before, faces)
        if told and not strips:  # a strip of three corners looks like one
            return None
        take = _of_binary(data, start, order) if order else _of_text(words)
        tables = {each.name: _table(take, each) for each in before}
        loops, numbers = _polygons(take, faces)
        if strips:
            loops, numbers = _triangles_of(loops, numbers)
        fewest, most = min(map(len, loops)), max(map(len, loops))
        if fewest == most == 3 and not strips:
            return None
        table = _cut(tables["vertex"], loops, numbers) if fewest >= 3 else None
    except (ValueError, IndexError, KeyError, StopIteration, OverflowError, struct.error):
        return None  # other readers say what is wrong
    if table is None:
        raise InputError(f"mesh {path}: a face with {fewest} corners; export it again")
    return encode_ply({"vertex": tables["vertex"], "face": table})


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """The order of bytes ("" of text), the elements, and where they begin."""
    head, mark, rest = data[: 1 << 16].partition(b"end_header")
    order, elements = "", list[_Element]()
    for line in head.splitlines():
        words = line.split()
        if words[:1] == [b"format"]:
            order = _ORDERS[words[1]]
        elif words[:1] == [b"element"]:
            elements.append(_Element(words[1].decode(), int(words[2]), []))
        elif words[:1] == [b"property"]:
            *kinds, name = [word.decode() for word in words[1:]]
            length = type_of(kinds[1]) if kinds[0] == "list" else None
            elements[-1].properties.append((name, type_of(kinds[-1]), length))
    return order, elements, len(head) + len(mark) + len(rest.partition(b"\n")[0]) + 1


def _are_triangles(data: bytes, start: int, order: str, before: list[_Element], faces: _Element) -> bool:
    """Whether all faces of a binary file have three corners, and no other list."""
    start += sum(each.rows * np.dtype(each.numbers()).itemsize for each in before)
    name, kind, length = faces.properties[0]
    row = np.dtype([("#", f"{order}{length}"), (name, order + kind, (3,)), *faces.numbers(order)])
    whole = len(data) - start >= faces.rows * row.itemsize
    return whole and bool((np.frombuffer(data, row, faces.rows, start)["#"] == 3).all())


def _are_triangles_in(words: list[bytes], before: list[_Element], faces: _Element) -> bool:
    """The same of a file in text."""
    start, wide = sum(each.rows * len(each.properties) for each in before), 4 + len(faces.numbers())
    counts = words[start : start + faces.rows * wide : wide]
    return len(counts) == faces.rows and all(count == b"3" for count in counts)


def _of_binary(data: bytes, start: int, order: str) -> Take:
    at = start

    def take(kind: str, count: int) -> tuple[Any, ...]:
        nonlocal at
        layout = f"{order}{count}{np.dtype(kind).char}"
        values = struct.unpack_from(layout, data, at)
        at += struct.calcsize(layout)
        return values

    return take


def _of_text(words: list[bytes]) -> Take:
    at = 0

    def take(kind: str, count: int) -> tuple[Any, ...]:
        nonlocal at
        if not 0 <= count <= len(words) - at:
            raise ValueError("a list beyond the file")
        at += count
        return tuple(map(float if kind[0] == "f" else int, words[at - count : at]))

    return take


def _table(take: Take, element: _Element) -> np.ndarray:
    """All rows of an element without lists."""
    kinds = [kind for _, kind, _ in element.properties]
    if not kinds:
        raise ValueError(f"{element.name} without properties")
    rows = [tuple(take(kind, 1)[0] for kind in kinds) for _ in range(element.rows)]
    return np.array(rows, element.numbers())


def _polygons(take: Take, faces: _Element) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """The corners of each face, and its numbers; other lists are passed over."""
    loops, rows = [], []
    for _ in range(faces.rows):
        row = [take(kind, 1 if length is None else take(length, 1)[0]) for _, kind, length in faces.properties]
        loops.append(row[0])
        rows.append(tuple(row[at][0] for at, (_, _, length) in enumerate(faces.properties) if length is None))
    return loops, np.array(rows, faces.numbers()) if faces.numbers() else np.empty(len(rows), [])


def _triangles_of(strips: list[tuple[int, ...]], numbers: np.ndarray) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """The triangles of strips, without those that have a corner twice, and the numbers of each one's strip."""
    loops, rows = list[tuple[int, ...]](), list[int]()
    for row, strip in enumerate(strips):
        corners, at = np.array(strip, dtype=np.int64), np.arange(len(strip))
        begun = np.maximum.accumulate(np.where(corners < 0, at + 1, 0)) if len(at) else at
        first, second, third = corners[:-2], corners[1:-1], corners[2:]
        odd = (at - begun)[:-2] % 2 == 1
        found = np.stack([np.where(odd, second, first), np.where(odd, first, second), third], axis=1)
        apart = (first != second) & (second != third) & (first != third)
        whole = found[apart & (found >= 0).all(axis=1)]
        loops += map(tuple, whole.tolist())
        rows += [row] * len(whole)
    return loops, numbers[rows]


def _cut(vertices: np.ndarray, loops: list[tuple[int, ...]], numbers: np.ndarray) -> np.ndarray:
    """The triangles of polygons as a table, each with the numbers of its polygon."""
    fans = [(loop[0], loop[k], loop[k + 1]) for loop in loops for k in range(1, len(loop) - 1)]
    triangles, counts = np.array(fans, dtype=np.int64), np.array([len(loop) for loop in loops])
    firsts = (counts - 2).cumsum() - (counts - 2)
    dented = [(int(first), int(count)) for first, count in zip(firsts, counts, strict=True) if count > 3]
    cut_concave(np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1), triangles, dented)
    if np.abs(triangles).max() > np.iinfo(np.int32).max:
        raise ValueError("a corner beyond 32 bits")
    rows = np.repeat(np.arange(len(loops)), counts - 2)
    table = np.empty(len(triangles), [(CORNERS, "<i4", (3,)), *(numbers.dtype.descr if numbers.dtype.names else [])])
    table[CORNERS] = triangles
    for name in numbers.dtype.names or ():
        table[name] = numbers[name][rows]
    return table
