"""Arrays of numbers as NumPy writes them: NPY, and NPZ with several by name. Nothing in them is run."""

import io
import threading
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

_HEADERS = threading.Lock()
"""NPY's header is Python, and CPython 3.11 loses count of its parser's depth where threads take turns within it."""

_LARGEST = 1 << 20
"""Bytes of an array in NPZ, at most: they are matrices, and a file of a few kilobytes may unpack to gigabytes."""


def load_npy(path: Path) -> np.ndarray:
    """The numbers of an NPY file, mapped: what it claims to hold is compared with its size before memory is taken.

    Raises:
        ValueError: it is damaged, or holds something else.
    """
    try:
        with _HEADERS:
            numbers = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy's parser of headers raises what it runs into
        raise ValueError("damaged, or no NPY file of numbers") from error
    if not isinstance(numbers, np.ndarray) or numbers.dtype.kind not in "fiu":
        raise ValueError("holds no array of numbers")
    return numbers


def names_in_npz(path: Path) -> set[str]:
    """What the arrays of an NPZ file are called.

    Raises:
        ValueError: it is no such file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy") for name in archive.namelist()}
    except Exception as error:  # as of what `load_npz` reads
        raise ValueError("damaged, or no NPZ file") from error


def load_npz(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Small arrays of an NPZ file, of at most 1 MiB each.

    Args:
        path: of the file.
        names: of the arrays; all must be there.

    Raises:
        ValueError: it is damaged, one of them is missing, too large, or holds something else than numbers.
    """
    found = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in names:
                record = archive.getinfo(f"{name}.npy")
                found[name] = _array(archive.read(record)) if record.file_size <= _LARGEST else None
    except Exception as error:  # zipfile, zlib and numpy's parser of headers raise what they run into
        raise ValueError("damaged, or no NPZ file of numbers") from error
    if odd := [name for name, numbers in found.items() if numbers is None]:
        raise ValueError(f"{odd[0]} holds no small array of numbers")
    return found


def _array(data: bytes) -> np.ndarray | None:
    """Of an NPY file's bytes; None of something else than numbers. Its header is not believed."""
    file = io.BytesIO(data)
    with _HEADERS:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_columns, kind = read_header(file)
    if kind.kind not in "fiu":
        return None
    return np.frombuffer(data, kind, offset=file.tell()).reshape(shape, order="F" if by_columns else "C")
