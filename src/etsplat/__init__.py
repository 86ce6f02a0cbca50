"""Differentiable triangle splatting: posed images in, triangles out.

Names are imported when they are first used, so that `import etsplat` and the command line's help do not wait for torch.
Which they are, and where each comes from, stands in `__init__.pyi`.
"""

import ast
import importlib
from typing import Any

with open(f"{__file__}i", encoding="utf-8") as _stub:
    _LISTED = ast.parse(_stub.read()).body

_HOME_OF = {
    alias.name: statement.module
    for statement in _LISTED
    if isinstance(statement, ast.ImportFrom) and statement.module
    for alias in statement.names
}

__all__ = list(_HOME_OF)  # pyright: ignore[reportUnsupportedDunderAll]  # it reads the stub instead


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value = importlib.import_module("importlib.metadata").version("etsplat")
    elif name in _HOME_OF:
        value = getattr(importlib.import_module(_HOME_OF[name]), name)
    else:
        raise AttributeError(f"module 'etsplat' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
