"""Surfaces as files: which kinds there are, and what writes each."""

import importlib
from pathlib import Path
from typing import Protocol, cast

from etsplat.io import writers
from etsplat.io.atomic import atomic_write
from etsplat.io.paths import kind_of
from etsplat.io.surface import Content, Surface


class Writer(Protocol):
    """A module of `etsplat.io.writers`: one kind of file, after which it is named.

    Attributes:
        HOLDS: what such files have room for; `write` leaves out the rest.
    """

    HOLDS: frozenset[Content]

    def write(self, path: Path, surface: Surface) -> None:
        """Write the file."""
        ...


def suffixes(holding: Content | None = None) -> list[str]:
    """Endings of the files that can be written; of those that have room for something."""
    return [f".{kind}" for kind in writers.purposes() if holding is None or holding in _writer(kind).HOLDS]


def writer_of(path: Path, holding: Content | None = None) -> Writer:
    """What writes the kind of file that a path ends in.

    Raises:
        ValueError: none does, or such files have no room for what they must hold.
    """
    if kind_of(path) not in suffixes(holding):
        raise ValueError(f"path: expected one of the suffixes {', '.join(suffixes(holding))}, got {path.name}")
    return _writer(kind_of(path)[1:])


def save_surface(path: Path, surface: Surface) -> None:
    """Write the kind of file that the path ends in. Atomic.

    Raises:
        ValueError: nothing writes that kind.
        InputError: the file cannot be written.
    """
    writer = writer_of(path)
    with atomic_write(path) as temporary:
        writer.write(temporary, surface)


def _writer(kind: str) -> Writer:
    return cast(Writer, importlib.import_module(f"{writers.__name__}.{kind}"))
