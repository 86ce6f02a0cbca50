"""Clouds of points of multi-view stereo and of laser scanners: PLY and LAS.

LAZ is not read: damaged files make what unpacks it (lazrs 0.8) abort the process.
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io.paths import kind_of, path_remedy
from etsplat.io.ply_tables import COLORS, load_points, read_ply_header

MAX_POINTS = 100_000_000
"""Larger clouds are refused before memory is taken for them."""

Cloud = tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"] | None]
"""Float64 positions as in the file, and float32 colours in [0, 1] as displayed, if the file has any."""

_CHUNK = 1_000_000

_HEADER, _RECORD = 227, 54
"""Bytes of the smallest header of a LAS file, and of that of each of the records behind it (ASPRS, LAS 1.2)."""


def load_cloud(path: Path | str) -> Cloud:
    """Read a cloud of points; those that are not finite are left out.

    Args:
        path: ends in .ply, or in .las, which needs laspy.

    Raises:
        InputError: the file is missing, damaged, of another kind, or has more than 100 million points, or none.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"points {path}: no such file; {path_remedy(path)}")
    if kind_of(path) not in _READERS:
        raise InputError(f"points {path}: not a kind that is read; convert them to PLY or LAS")
    points, colors = _READERS[kind_of(path)](path)
    if not len(points):
        raise InputError(f"points {path}: there is none in it; export it again")
    return points, colors


def _ply(path: Path) -> Cloud:
    header = read_ply_header(path)
    _check_count(path, header.tables.get("vertex", (0,))[0])
    points, colors = load_points(path)
    return points, colors if set(COLORS) <= header.properties("vertex") else None


def _las(path: Path) -> Cloud:
    laspy = _import()
    _check_las(path)
    try:
        with laspy.open(path, read_evlrs=False) as file:
            header = file.header
            _check_count(path, header.point_count)
            end = header.offset_to_point_data + header.point_count * header.point_format.size
            if end > path.stat().st_size:
                raise InputError(f"points {path}: cut short; export it again")
            colored = set(COLORS) <= set(header.point_format.dimension_names)
            names = ("x", "y", "z", *(COLORS if colored else ()))
            parts = [
                np.stack([np.asarray(chunk[name], dtype=np.float64) for name in names], axis=1)
                for chunk in file.chunk_iterator(_CHUNK)
            ]
    except InputError:
        raise
    except Exception as error:  # whatever its parser runs into
        detail = (str(error).splitlines() or [type(error).__name__])[0][:100]
        raise InputError(f"points {path}: damaged, or no LAS ({detail}); export it again") from error
    rows = torch.from_numpy(np.concatenate([np.zeros((0, len(names))), *parts]))
    rows = rows[rows.isfinite().all(dim=1)]
    if not colored or not bool(rows[:, 3:].any()):  # many programs write black for unknown
        return rows[:, :3].contiguous(), None
    highest = 255 if float(rows[:, 3:].max()) <= 255 else 65535  # some write 8 bits into the field of 16
    return rows[:, :3].contiguous(), (rows[:, 3:] / highest).float()


def _check_las(path: Path) -> None:
    """Raises InputError where the header claims more than the file holds, for which laspy would take memory or time."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(_HEADER)
    if len(head) < _HEADER or head[:4] != b"LASF":
        raise InputError(f"points {path}: damaged, or no LAS; export it again")
    header_size, offset, records, kind = struct.unpack_from("<HIIB", head, 94)
    if kind & 0xC0:
        raise InputError(f"points {path}: is compressed; write it as LAS without compression")
    if not _HEADER <= header_size <= offset <= size or records * _RECORD > offset - header_size:
        raise InputError(f"points {path}: damaged or cut short; export it again")


def _check_count(path: Path, count: int) -> None:
    if count > MAX_POINTS:
        raise InputError(f"points {path}: has {count:,} points, more than {MAX_POINTS // 10**6} million; thin it")


def _import() -> Any:
    try:
        import laspy
    except ImportError as error:
        raise InputError("points in LAS need laspy: pip install 'etsplat[depth]'") from error
    return laspy


_READERS = {".ply": _ply, ".las": _las}
