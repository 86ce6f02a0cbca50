"""What `import etsplat` offers: listed once, in __init__.pyi, and loaded when it is first used."""

import ast
import importlib
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import etsplat

STUB = Path(etsplat.__file__).with_suffix(".pyi")
LISTED = [
    (statement.module, alias)
    for statement in ast.parse(STUB.read_text(encoding="utf-8")).body
    if isinstance(statement, ast.ImportFrom)
    for alias in statement.names
]


def test_a_name_is_listed_once() -> None:
    """In the stub, in the form in which type checkers pass it on (`x as x`), and not in __init__.py again."""
    names = [alias.name for _, alias in LISTED]
    assert len(set(names)) == len(names)
    assert [alias.asname for _, alias in LISTED] == names
    assert etsplat.__all__ == names
    source = Path(etsplat.__file__).read_text(encoding="utf-8")
    assert [name for name in names if f'"{name}"' in source or f"import {name}" in source] == []


@pytest.mark.parametrize(("home", "name"), [(home, alias.name) for home, alias in LISTED])
def test_a_name_is_there_and_explained(home: str, name: str) -> None:
    """It is what its home defines, not what that has from elsewhere; classes and functions have a docstring."""
    value = getattr(etsplat, name)
    assert value is getattr(importlib.import_module(home), name)
    assert getattr(value, "__module__", home) == home
    assert not callable(value) or value.__doc__
    assert name in dir(etsplat)


def test_other_names_are_refused() -> None:
    """As any module does it; the version is that of the package."""
    assert etsplat.__version__ == version("etsplat")
    with pytest.raises(AttributeError, match="module 'etsplat' has no attribute 'rasterise'"):
        etsplat.rasterise  # noqa: B018  # pyright: ignore


def test_nothing_heavy_is_imported() -> None:
    """Before a name is used there is neither torch nor numpy; the list is read in a moment, 60 ms at the most."""
    program = """
import sys, time
before = time.process_time()
import etsplat
print({"torch", "numpy", "matplotlib"} & set(sys.modules), time.process_time() - before)
etsplat.InputError
"""
    command = [sys.executable, "-c", program]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True).stdout.split() for _ in range(3)]
    assert {found for found, _ in runs} == {"set()"}
    assert min(float(seconds) for _, seconds in runs) < 0.06
