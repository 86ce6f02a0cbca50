"""A CUDA source with its definitions: the unit that is compiled, cached and launched from."""

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import etsplat

_INCLUDE = re.compile(r'^#include "(.+)"$')


@dataclass(frozen=True)
class Program:
    """One file of csrc/cuda, specialised by preprocessor definitions.

    Attributes:
        file: Name in csrc/cuda, such as "fill.cu". Its kernels are ``extern "C" __global__``.
        defines: (name, value) pairs; constants that the compiler should know.
        contract: Whether a b + c may be rounded once. Without, results are those of the CPU engine to the bit; that
            costs nothing where bytes are the bound.
        flush: Whether numbers nearer to 0 than 1.2e-38 are 0, which spares what powers, logarithms and quotients need
            to know them.
    """

    file: str
    defines: tuple[tuple[str, int | str], ...] = ()
    contract: bool = True
    flush: bool = False

    @property
    def source(self) -> str:
        """The definitions and the file with what it includes, as one text without ``#include "..."``."""
        defines = "".join(f"#define {name} {value}\n" for name, value in self.defines)
        return defines + _flattened(self.file)

    def __str__(self) -> str:
        return " ".join([self.file, *(f"{name}={value}" for name, value in self.defines)])


def source_root() -> Path:
    """The folder csrc: beside the package where it was installed from a wheel, in the checkout otherwise."""
    package = Path(etsplat.__file__).resolve().parent
    installed = package / "csrc"
    return installed if installed.is_dir() else package.parent.parent / "csrc"


def included(path: Path, name: str) -> Path:
    """The file that ``path`` means by ``#include "name"``."""
    beside = path.parent / name
    return beside if beside.is_file() else source_root() / name


@lru_cache(maxsize=64)
def _flattened(file: str) -> str:
    lines: list[str] = []
    _append(source_root() / "cuda" / file, lines, set())
    return "\n".join(lines) + "\n"


def _append(path: Path, lines: list[str], seen: set[Path]) -> None:
    """Add the lines of ``path``, with its includes in their place; each file once, as ``#pragma once`` has it."""
    if path in seen:
        return
    seen.add(path)
    name = path.relative_to(source_root()).as_posix()
    lines.append(f'#line 1 "{name}"')
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        include = _INCLUDE.match(line)
        if include:
            _append(included(path, include[1]), lines, seen)
            lines.append(f'#line {number + 1} "{name}"')
        elif line != "#pragma once":
            lines.append(line)
        else:
            lines.append("")
