"""What files of `etsplat export` say of how they were made, and so where they lie in the frame of their capture."""

from itertools import takewhile
from pathlib import Path
from typing import Any

import torch

from etsplat.core.errors import InputError
from etsplat.geometry.similarity import Similarity
from etsplat.io._gltf import split_gltf
from etsplat.io.json_text import parse_json
from etsplat.io.paths import kind_of
from etsplat.io.ply_tables import read_ply_comments

_ENTRIES = ("transform", "up", "place", "georeference", "appearance", "notes")
"""What is read again; the rest is for people."""

LED_BACK = "etsplat export had turned, scaled or moved it: it is led back to where it was"
"""Said of a file whose record leads back."""

_Z_TO_Y = torch.tensor([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64, device="cpu")
"""What the nodes of a GLB do with a world that has z up."""


def read_record(path: Path) -> dict[str, Any]:
    """What a readable GLB, PLY or OBJ has of `_ENTRIES`; empty of files of others, and of kinds without room for it.

    Raises:
        InputError: it is damaged.
    """
    if kind_of(path) == ".ply":
        comments = read_ply_comments(path)
        return _of_lines(path, comments) if any(line.startswith("etsplat ") for line in comments) else {}
    if kind_of(path) == ".obj":
        with open(path, encoding="utf-8", errors="replace") as file:
            lines = [line[2:].rstrip() for line in takewhile(lambda line: line.startswith("# "), file)]
        return _of_lines(path, lines) if any(line.startswith("transform [[") for line in lines) else {}
    if kind_of(path) not in (".glb", ".gltf"):
        return {}
    found: Any = split_gltf(path.read_bytes())[0]
    for name in ("asset", "extras", "etsplat"):
        found = found.get(name) if isinstance(found, dict) else None
    return {name: found[name] for name in _ENTRIES if name in found} if isinstance(found, dict) else {}


def transform_of_record(path: Path, record: dict[str, Any]) -> Similarity:
    """From the capture's own units and axes to the coordinates in a file; nothing where the record says nothing.

    Raises:
        InputError: it is none that files are turned, scaled and placed by.
    """
    if "transform" not in record:
        return Similarity()
    try:
        matrix = torch.tensor(record["transform"], dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise damaged(path, "transform") from error
    if matrix.shape != (4, 4) or not bool(matrix.isfinite().all()) or matrix[3].tolist() != [0, 0, 0, 1]:
        raise damaged(path, "transform")
    world = record.get("georeference") if record.get("place") == "world" else None
    if kind_of(path) in (".glb", ".gltf") and isinstance(world, dict) and world.get("up") == "z":
        matrix = _Z_TO_Y @ matrix
    if not float(torch.linalg.det(matrix[:3, :3])) > 0:
        raise damaged(path, "transform")
    found = Similarity.of_matrix(matrix)
    if not bool(((found.rotation @ found.rotation.T - torch.eye(3)).abs() < 1e-6).all()):
        raise damaged(path, "transform")
    return found


def damaged(path: Path, name: str) -> InputError:
    """About an entry that cannot be used."""
    return InputError(f"soup {path}: its record of the export has no usable `{name}`; export it again")


def _of_lines(path: Path, lines: list[str]) -> dict[str, Any]:
    """Of lines that have a name and JSON each."""
    record = {}
    for name, _, text in (line.partition(" ") for line in lines):
        if name in _ENTRIES:
            try:
                record[name] = parse_json(text)
            except ValueError as error:
                raise damaged(path, name) from error
    return record
