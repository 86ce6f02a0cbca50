"""Structs that kernels take by value, and constants, from their C++ declaration: one place says what they are."""

import ctypes
import math
import re
from functools import cache
from pathlib import Path
from typing import Any

from torch import Tensor

from etsplat.engines.cuda.program import included, source_root

_TYPES = {
    "float": ctypes.c_float,
    "int": ctypes.c_int32,
    "unsigned": ctypes.c_uint32,
    "long long": ctypes.c_int64,
}
_MEMBERS = re.compile(r"^(?:const )?(.+?) ?(\*? ?\w+(?:, \*?\w+)*)(?:\[(\w+)\])?;$")  # type, names with stars, count


class Struct(ctypes.Structure):
    """Pointers, 0 at first like everything else, are set to contiguous tensors, which the struct does not keep."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Also of the arguments of the constructor, and of all elements of a list for an array."""
        super().__setattr__(name, tuple(map(_address, value)) if isinstance(value, list) else _address(value))

    def set(self, *first: Any, **others: Any) -> None:
        """The first members in their order, and others by name."""
        for member, value in zip(self._fields_, first, strict=False):
            setattr(self, member[0], value)
        for name, value in others.items():
            setattr(self, name, value)


def _address(value: Any) -> Any:
    if not isinstance(value, Tensor):
        return value
    assert value.is_contiguous(), "kernels get contiguous tensors only"
    return value.data_ptr()


@cache
def struct_class(file: str, name: str) -> type[Struct]:
    """A ctypes.Structure with the members of ``struct name`` in csrc/``file``, or in what that includes.

    The struct holds pointers, numbers and other structs of these files, one type a line, or an array a line whose
    length is a constant of the file.
    """
    declared = _declared(source_root() / file, name)
    assert declared, f"{file}: no struct {name}"
    if (where := declared.relative_to(source_root()).as_posix()) != file:
        return struct_class(where, name)
    body = declared.read_text(encoding="utf-8").split(f"struct {name} {{\n", 1)[1].split("\n};", 1)[0]
    fields: list[tuple[str, Any]] = []
    for line in body.splitlines():
        code = line.split("//")[0].strip()
        if not code:
            continue
        match = _MEMBERS.match(code)
        assert match, f"{file}: not understood: {line}"
        for member in match[2].split(","):
            if "*" in member:
                kind = ctypes.c_void_p
            else:
                kind = _TYPES[match[1]] if match[1] in _TYPES else struct_class(file, match[1])
            if match[3]:
                kind = kind * constant(file, match[3])
            fields.append((member.strip(" *"), kind))
    return type(name, (Struct,), {"_fields_": fields})


def _declared(path: Path, name: str) -> Path | None:
    """The file that declares a struct: this one, or one that it includes."""
    text = path.read_text(encoding="utf-8")
    if f"struct {name} {{\n" in text:
        return path
    others = (included(path, other) for other in re.findall(r'^#include "(.+)"$', text, re.MULTILINE))
    return next(filter(None, (_declared(other, name) for other in others)), None)


@cache
def constant(file: str, name: str) -> int:
    """The value of ``constexpr int name`` in csrc/``file``: a product of numbers and such constants of the file."""
    text = (source_root() / file).read_text(encoding="utf-8")
    value = re.search(rf"^constexpr int {name} = (\w+(?: \* \w+)*);", text, re.MULTILINE)
    assert value, f"{file}: no constant {name}"
    return math.prod(int(word) if word.isdigit() else constant(file, word) for word in value[1].split(" * "))
