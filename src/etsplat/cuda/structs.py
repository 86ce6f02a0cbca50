"""Structs that kernels take by value, from their C++ declaration: one place says what they hold."""

import ctypes
import re
from functools import cache
from typing import Any

from etsplat.cuda.program import source_root

_TYPES = {
    "float": ctypes.c_float,
    "int": ctypes.c_int32,
    "unsigned": ctypes.c_uint32,
}
_MEMBERS = re.compile(r"^(?:const )?(float|double|int|unsigned char|unsigned long long|long long|unsigned)\b(.+);$")


@cache
def struct_class(header: str, name: str) -> Any:
    """A ctypes.Structure with the members of ``struct name`` in csrc/``header``.

    The struct holds pointers, int, unsigned and float, declared on one line per type. Pointers are addresses here, 0 at
    first like everything else.
    """
    text = (source_root() / header).read_text(encoding="utf-8")
    body = text.split(f"struct {name} {{\n", 1)[1].split("\n};", 1)[0]
    fields: list[tuple[str, Any]] = []
    for line in body.splitlines():
        code = line.split("//")[0].strip()
        if not code:
            continue
        match = _MEMBERS.match(code)
        assert match, f"{header}: not understood: {line}"
        for member in match[2].split(","):
            pointer = "*" in member
            fields.append((member.replace("*", "").strip(), ctypes.c_void_p if pointer else _TYPES[match[1]]))
    return type(name, (ctypes.Structure,), {"_fields_": fields})
