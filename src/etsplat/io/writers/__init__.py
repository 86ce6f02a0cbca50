"""Kinds of mesh files for other programs, a module each: `ply.py` writes .ply. It is found by being here.

`etsplat.io.surface_files.Writer` says what a module holds. Its first line says what its files are for: the command
line's help shows it.
"""

from pathlib import Path


def purposes() -> dict[str, str]:
    """What each kind of file is for, by its name, without importing the modules: help must not wait for numpy."""
    modules = sorted(module for folder in __path__ for module in Path(folder).glob("[!_]*.py"))
    return {module.stem: module.read_text(encoding="utf-8").splitlines()[0].strip('"') for module in modules}
