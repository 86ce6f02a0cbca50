"""Compact soups: quantised, the most important triangles first, so that any part of the file from its start draws.

The format is described in docs/compact_format.md. Files end in .etz.
"""

import bisect
import itertools
import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from etsplat.core.errors import InputError
from etsplat.core.harmonics import MAX_DEGREE
from etsplat.core.spelling import either
from etsplat.io.byte_planes import MOST_INFLATED, MOST_ROWS, Channel, pack_chunk, row_bytes, unpack_chunk
from etsplat.io.json_text import entries_problem, is_number, parse_json

MAGIC, VERSION = b"ETSZ", 1
CHUNK = 4096
"""Triangles of a chunk, as they are written here."""

_HEAD = struct.Struct("<4sII")  # magic, version, bytes of the header
_SIZES_PER_OCTAVE = 8
_OFFSET_STEPS = 1023
_CONSTANT_STEP = 1 / 128
_BAND_STEP = 1 / 64
_FINEST = (1 << 24) - 1  # of a centre's coordinate
_MOST_ENLARGED = 1e4

Places = dict[str, np.ndarray]


@dataclass(frozen=True)
class CompactSoup:
    """N separate triangles, the most important first: soft ones with harmonics, or opaque ones with colours at corners.

    Attributes:
        vertices: (N, 3, 3) float32 corners.
        opacities: (N,) in [0, 1]; None of opaque triangles, like the two after it.
        sigma: (N,) softness, above 0.
        harmonics: (N, K, 3) coefficients, K = (degree + 1)^2.
        corner_colors: (N, 3, 3) in [0, 1]; None of soft triangles.
        appearance: how they are drawn, as `SoupAppearance.to_json` says it.
        notes: text by name.
        left_out: how many triangles are missing at the end of a file that was cut short; soft ones are larger for them.
    """

    vertices: np.ndarray
    opacities: np.ndarray | None = None
    sigma: np.ndarray | None = None
    harmonics: np.ndarray | None = None
    corner_colors: np.ndarray | None = None
    appearance: Mapping[str, Any] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.vertices)


def enlargement(share: float) -> float:
    """How much larger soft triangles are drawn about their centres if only the first `share` of a soup is, in (0, 1].

    So that they cover what the others would: fitted to prefixes of two scenes (research/results.md). At most as
    large as equal triangles would have to be, and with many left out less than that.
    """
    depth = -math.log(share)
    return math.exp(min(0.08 * depth, 0.2) * depth)


def encode_compact(soup: CompactSoup) -> bytes:
    """The file's bytes. Numbers lose what nobody sees of them.

    Args:
        soup: with at least one triangle; all of its numbers are finite.
    """
    scales = _scales(soup)
    bases = 0 if soup.harmonics is None else soup.harmonics.shape[1]
    channels = _channels(bases)
    chunks = []
    for start in range(0, len(soup), CHUNK):  # one by one: whole numbers of all at once would be the largest array here
        table = _quantised(soup, scales, slice(start, start + CHUNK))
        rows = _along_a_curve(table["center"])
        chunks.append((len(rows), pack_chunk(channels, {name: values[rows] for name, values in table.items()})))
    header = {
        "format": "etsplat compact soup",
        "count": len(soup),
        "bases": bases,
        "chunks": [[count, len(data)] for count, data in chunks],
        **({"enlarged": _enlarged([count for count, _ in chunks])} if bases else {}),
        **scales,
        "appearance": dict(soup.appearance),
        "notes": dict(sorted(soup.notes.items())),  # safetensors gives them in any order
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    return b"".join([_HEAD.pack(MAGIC, VERSION, len(text)), text, *(data for _, data in chunks)])


def read_compact(path: Path | str) -> CompactSoup:
    """Read a compact soup, or those of its triangles that are whole in a file that was cut short.

    Raises:
        InputError: the file is missing, damaged, of another kind, or cut short before its first triangles.
    """
    path = Path(path)
    try:
        return decode_compact(path.read_bytes())
    except (OSError, ValueError) as error:
        detail = (str(error) or type(error).__name__).splitlines()[0]
        again = either("with --format etz", "to a path that ends in .etz")
        raise InputError(f"soup {path}: cannot be read ({detail}); export it again {again}") from error


def decode_compact(data: bytes) -> CompactSoup:
    """What `encode_compact` was given, but for what the file's numbers lose.

    Raises:
        ValueError: these are no bytes of a compact soup, or of another version.
    """
    header, start = _header(data)
    channels = _channels(header["bases"])
    ends = list(itertools.accumulate((size for _, size in header["chunks"]), initial=start))
    whole = bisect.bisect_right(ends, len(data)) - 1
    if whole < 1:
        raise ValueError("it is cut short before its first triangles")
    factor = float(header["enlarged"][whole - 1]) if "enlarged" in header else 1.0
    parts = []
    for (rows, _), first, end in zip(header["chunks"][:whole], ends, ends[1:], strict=False):
        parts.append(_restored(header, unpack_chunk(channels, rows, data[first:end]), factor))
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    left_out = header["count"] - len(arrays["vertices"])
    return CompactSoup(**arrays, appearance=header["appearance"], notes=header["notes"], left_out=left_out)


def _enlarged(counts: Sequence[int]) -> list[float]:
    """How much larger triangles are drawn where chunks end after this one; of the last one 1."""
    ends = list(itertools.accumulate(counts))
    return [round(enlargement(end / ends[-1]), 4) for end in ends]


def _channels(bases: int) -> list[Channel]:
    """What each triangle has in the file; `bases` 0: colours at corners."""
    place = [Channel("center", 3, 3, delta=True), Channel("size", 1, 1), Channel("offsets", 6, 2, signed=True)]
    if not bases:
        return [*place, Channel("colors", 9, 1)]
    soft = [Channel("opacity", 1, 1), Channel("sigma", 1, 1), Channel("constant", 3, 2, signed=True)]
    return [*place, *soft, Channel("rest", 3 * (bases - 1), 2, signed=True)]


def _scales(soup: CompactSoup) -> dict[str, Any]:
    """What the header says of the numbers."""
    centers = soup.vertices.mean(axis=1, dtype=np.float64)
    reach = np.abs(_offsets(soup.vertices, centers)).max(axis=1)
    least = max(float(reach.max()) * 2.0 ** (-255 / _SIZES_PER_OCTAVE), 1e-30)
    origin = centers.min(axis=0)
    span = float((centers - origin).max())
    # Small triangles are placed to a fraction of their size, as far as 24 bits go.
    step = max(span / _FINEST, float(np.quantile(reach, 0.1)) / 128, 1e-30)
    scales: dict[str, Any] = {
        "center": {"origin": origin.tolist(), "step": step},
        "size": {"least": least, "per_octave": _SIZES_PER_OCTAVE},
        "offset": {"steps": _OFFSET_STEPS},
    }
    if soup.corner_colors is not None:
        return scales
    assert soup.sigma is not None
    assert soup.harmonics is not None
    logs = _logs(soup.sigma)
    low, high = float(logs.min()), float(logs.max())
    # Where coefficients are out of proportion the step grows: 16 bits hold them all.
    largest = [
        max(float(part.max(initial=0.0)), -float(part.min(initial=0.0))) / 32767
        for part in (soup.harmonics[:, :1], soup.harmonics[:, 1:])
    ]
    return scales | {
        "sigma": {"low": low, "step": max((high - low) / 255, 1e-9)},
        "constant": {"step": max(_CONSTANT_STEP, largest[0])},
        "rest": {"step": max(_BAND_STEP, largest[1])},
    }


def _offsets(vertices: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """(n, 6) of the first two corners from the middle; the third corner follows."""
    return (vertices.astype(np.float64) - centers[:, None])[:, :2].reshape(-1, 6)


def _logs(sigma: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(sigma.astype(np.float64), 1e-30))


def _quantised(soup: CompactSoup, scales: Mapping[str, Any], rows: slice) -> Places:
    """Whole numbers (n, width) of each channel, of some of the triangles."""
    vertices, least = soup.vertices[rows], scales["size"]["least"]
    centers = vertices.mean(axis=1, dtype=np.float64)
    offsets = _offsets(vertices, centers)
    reach = np.abs(offsets).max(axis=1)
    size = np.ceil(_SIZES_PER_OCTAVE * np.log2(np.maximum(reach, least) / least)).clip(0, 255)
    unit = least * 2.0 ** (size / _SIZES_PER_OCTAVE) / _OFFSET_STEPS
    places = (centers - np.array(scales["center"]["origin"])) / scales["center"]["step"]
    table = {
        "center": np.rint(places).clip(0, _FINEST),
        "size": size[:, None],
        "offsets": np.rint(offsets / unit[:, None]).clip(-_OFFSET_STEPS, _OFFSET_STEPS),
        **_quantised_colors(soup, scales, rows),
    }
    return {name: values.astype(np.int64) for name, values in table.items()}


def _quantised_colors(soup: CompactSoup, scales: Mapping[str, Any], rows: slice) -> Places:
    if soup.corner_colors is not None:
        return {"colors": np.rint(soup.corner_colors[rows].reshape(-1, 9) * 255).clip(0, 255)}
    assert soup.opacities is not None
    assert soup.sigma is not None
    assert soup.harmonics is not None
    harmonics = soup.harmonics[rows]
    rest = harmonics[:, 1:].reshape(len(harmonics), -1).astype(np.float64)
    return {
        "opacity": np.rint(soup.opacities[rows, None] * 255.0).clip(0, 255),
        "sigma": np.rint((_logs(soup.sigma[rows])[:, None] - scales["sigma"]["low"]) / scales["sigma"]["step"]).clip(
            0, 255
        ),
        "constant": np.rint(harmonics[:, 0] / scales["constant"]["step"]),
        "rest": np.rint(rest / scales["rest"]["step"]),
    }


def _restored(header: Mapping[str, Any], table: Places, factor: float) -> dict[str, np.ndarray]:
    """Whole numbers to what they stand for, by the names of `CompactSoup`; triangles `factor` times as large."""
    # Numbers that JSON has without a point may be larger than whole numbers of numpy.
    centers = np.array(header["center"]["origin"], dtype=np.float64) + float(header["center"]["step"]) * table["center"]
    size = header["size"]["least"] * 2.0 ** (table["size"] / header["size"]["per_octave"])
    first = (factor * size / header["offset"]["steps"] * table["offsets"]).reshape(-1, 2, 3)
    offsets = np.concatenate([first, -first.sum(axis=1, keepdims=True)], axis=1)
    place = {"vertices": (centers[:, None] + offsets).astype(np.float32)}
    if not header["bases"]:
        return {**place, "corner_colors": (table["colors"].reshape(-1, 3, 3) / 255).astype(np.float32)}
    bands = [float(header[name]["step"]) * table[name] for name in ("constant", "rest")]
    sigma = np.exp(header["sigma"]["low"] + float(header["sigma"]["step"]) * table["sigma"][:, 0])
    return {
        **place,
        "opacities": (table["opacity"][:, 0] / 255).astype(np.float32),
        "sigma": sigma.astype(np.float32),
        "harmonics": np.concatenate(bands, axis=1).reshape(len(centers), header["bases"], 3).astype(np.float32),
    }


def _header(data: bytes) -> tuple[dict[str, Any], int]:
    """What the header says, and where the first chunk begins. Raises ValueError."""
    if len(data) < _HEAD.size or data[:4] != MAGIC:
        raise ValueError("it is no compact soup")
    _, version, length = _HEAD.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"it is of version {version}, and this etsplat reads version {VERSION}")
    if _HEAD.size + length > len(data):
        raise ValueError("it is cut short before its first triangles")
    header = parse_json(data[_HEAD.size : _HEAD.size + length])
    kinds = {"count": int, "bases": int, "center": dict, "center.step": float, "size": dict, "size.least": float}
    kinds |= {"size.per_octave": float, "offset": dict, "offset.steps": float, "appearance": dict, "notes": dict}
    if isinstance(header, dict) and header.get("bases"):
        kinds |= {"sigma": dict, "sigma.low": float, "sigma.step": float}
        kinds |= {"constant": dict, "constant.step": float, "rest": dict, "rest.step": float}
    if problem := entries_problem(header, kinds, kinds):
        raise ValueError(f"its header {problem}")
    if header["bases"] not in [0, *((degree + 1) ** 2 for degree in range(MAX_DEGREE + 1))]:
        raise ValueError(f"its header has {header['bases']} bases of colours")
    origin = header["center"].get("origin")
    if not (isinstance(origin, list) and len(origin) == 3 and all(map(is_number, origin))):
        raise ValueError("its header has no origin")
    _check_scales(header)
    _check_chunks(header)
    return header, _HEAD.size + length


def _check_scales(header: Mapping[str, Any]) -> None:
    """Raises ValueError for scales with which numbers would not be finite."""
    positive = [header["size"]["least"], header["size"]["per_octave"], header["offset"]["steps"]]
    if min(positive) <= 0 or 255 / header["size"]["per_octave"] + math.log2(header["size"]["least"]) > 120:
        raise ValueError("its header has sizes that are none")
    if header["bases"] and abs(header["sigma"]["low"]) + 255 * abs(header["sigma"]["step"]) > 80:
        raise ValueError("its header has a softness that is none")
    if not all(isinstance(text, str) for text in header["notes"].values()):
        raise ValueError("its header has notes that are no text")


def _check_chunks(header: Mapping[str, Any]) -> None:
    """Raises ValueError where what chunks claim to hold is not what their bytes can."""
    chunks = header.get("chunks")
    if not isinstance(chunks, list) or not all(_is_pair(chunk) for chunk in chunks):
        raise ValueError("its header has no chunks")
    each = row_bytes(_channels(header["bases"]))
    if any(not 0 < rows <= MOST_ROWS or rows * each > MOST_INFLATED * size for rows, size in chunks):
        raise ValueError("its header has chunks that cannot hold their triangles")
    if sum(rows for rows, _ in chunks) != header["count"]:
        raise ValueError("its header has another number of triangles than its chunks")
    factors = header.get("enlarged", len(chunks) * [1])
    if not isinstance(factors, list) or len(factors) != len(chunks) or not all(map(_is_factor, factors)):
        raise ValueError("its header enlarges triangles by what is no factor of each chunk")


def _is_pair(chunk: object) -> bool:
    return (
        isinstance(chunk, list)
        and len(chunk) == 2
        and all(isinstance(number, int) and not isinstance(number, bool) and number > 0 for number in chunk)
    )


def _is_factor(factor: Any) -> bool:
    return is_number(factor) and 1 <= factor <= _MOST_ENLARGED


def _along_a_curve(centers: np.ndarray) -> np.ndarray:
    """The order of (n, 3) whole numbers below 2^24 along Morton's curve, on which neighbours are near each other."""
    code = np.zeros(len(centers), np.int64)
    for axis, values in enumerate(centers.T):
        spread = values.astype(np.int64) >> 3  # 21 bits of each axis are 63
        for shift, mask in _SPREADING:
            spread = (spread | (spread << shift)) & mask
        code |= spread << axis
    return np.argsort(code, kind="stable")


_SPREADING: Sequence[tuple[int, int]] = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
