"""Structs that kernels take by value, from their C++ declaration: one place says what they hold."""

import ctypes
import re
from functools import cache
from typing import Any

from etsplat.engines.cuda.program import source_root

_TYPES = {
    "float": ctypes.c_float,
    "int": ctypes.c_int32,
    "unsigned": ctypes.c_uint32,
    "long long": ctypes.c_int64,
}
_MEMBERS = re.compile(r"^(?:const )?(.+?) ?(\*? ?\w+(?:, \*?\w+)*);$")  # a type, and names with their stars


@cache
def struct_class(file: str, name: str) -> Any:
    """A ctypes.Structure with the members of ``struct name`` in csrc/``file``.

    The struct holds pointers, numbers and other structs of the file, one type a line. Pointers are addresses here, 0
    at first like everything else.
    """
    text = (source_root() / file).read_text(encoding="utf-8")
    body = text.split(f"struct {name} {{\n", 1)[1].split("\n};", 1)[0]
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
            fields.append((member.strip(" *"), kind))
    return type(name, (ctypes.Structure,), {"_fields_": fields})
