"""What is reconstructed: meshes, which are photographed, and captures, whose true surface may lie beside the photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from etsplat.core.errors import InputError
from studies.grid.variants import find_meshes

SURFACE = "mesh.obj"
"""The true surface in the folder of a capture, in the world of its cameras."""


@dataclass(frozen=True)
class Subject:
    """One object.

    Attributes:
        name: of the file without suffix, or of the folder.
        source: the mesh file, or the folder of the capture.
        surface: file of the true surface, in the units of the source; None where it is not known.
    """

    name: str
    source: Path
    surface: Path | None


def find_subjects(inputs: Sequence[Path], objects: Sequence[str]) -> list[Subject]:
    """The objects of some folders, in their order, or those asked for.

    Args:
        inputs: each a capture, a folder of captures, or a folder of mesh files.
        objects: names; all if there are none.

    Raises:
        InputError: no such folder, nothing in it, a name that two objects have, or one that none has.
    """
    found: dict[str, Subject] = {}
    for folder in inputs:
        for subject in _subjects_of(folder):
            if subject.name in found:
                raise InputError(
                    f"inputs {folder}: {subject.source} and {found[subject.name].source} have the same name; rename one"
                )
            found[subject.name] = subject
    if missing := [name for name in objects if name not in found]:
        raise InputError(f"objects: none is named {missing[0]}; there are {', '.join(found)}")
    return [found[name] for name in objects or found]


def _subjects_of(folder: Path) -> list[Subject]:
    if not folder.is_dir():
        raise InputError(f"inputs {folder}: no such folder; name folders of meshes or of captures")
    captures = [folder] if _is_capture(folder) else [path for path in sorted(folder.iterdir()) if _is_capture(path)]
    if captures:
        surfaces = [path / SURFACE for path in captures]
        return [
            Subject(path.resolve().name, path, surface if surface.is_file() else None)
            for path, surface in zip(captures, surfaces, strict=True)
        ]
    return [Subject(name, path, path) for name, path in find_meshes(folder, ()).items()]


def _is_capture(path: Path) -> bool:
    return path.is_dir() and (any(path.glob("transforms*.json")) or (path / "sparse").is_dir())
