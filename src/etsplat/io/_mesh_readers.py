"""Mesh readers by suffix. OBJ has its own (it keeps the file's connectivity); the others go through trimesh.

trimesh is imported where it is used: it takes half a second, which runs without such files need not wait for.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from etsplat.core.errors import InputError
from etsplat.io.srgb import srgb_from_linear

if TYPE_CHECKING:
    import trimesh


@dataclass
class RawMesh:
    """What a file says, unchecked: arrays of any dtype; colours (·, 3) in [0, 1] as displayed, or None.

    A file with colours of both kinds gives those of its faces: the others are often means of them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_colors: np.ndarray | None = None
    vertex_colors: np.ndarray | None = None
    file_faces: int | None = None
    """Faces in the file before polygons were cut into triangles, where the format tells."""


def read_obj(path: Path) -> RawMesh:
    """Positions (with the colours that may follow them) and faces of a Wavefront OBJ; everything else is ignored."""
    rows: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    file_faces = 0
    with open(path, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.split()
            try:
                if words[:1] == ["v"]:
                    rows.append(_obj_vertex(words))
                elif words[:1] == ["f"]:
                    corners = _obj_corners(words, len(rows))
                    file_faces += 1
                    faces += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
            except ValueError as error:
                raise InputError(
                    f"mesh {path}: line {number} is not valid OBJ ({error}); is the file cut short? Export it again"
                ) from error
    table = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
    colored = len(rows) > 0 and all(len(row) == 6 for row in rows)
    colors = np.clip(np.array([row[3:] for row in rows], dtype=np.float64), 0, 1) if colored else None
    return RawMesh(table, np.array(faces, dtype=np.int64).reshape(-1, 3), vertex_colors=colors, file_faces=file_faces)


def _obj_vertex(words: list[str]) -> list[float]:
    if len(words) not in (4, 5, 7, 8):  # x y z [w] [r g b] (with alpha in some exporters)
        raise ValueError(f"a vertex with {len(words) - 1} numbers")
    values = [float(word) for word in words[1:]]
    return values[:6] if len(values) >= 6 else values[:3]


def _obj_corners(words: list[str], vertex_count: int) -> list[int]:
    if len(words) < 4:
        raise ValueError(f"a face with {len(words) - 1} corners")
    corners = [int(word.split("/", 1)[0]) for word in words[1:]]
    if 0 in corners:
        raise ValueError("vertex number 0; they count from 1")
    return [corner - 1 if corner > 0 else vertex_count + corner for corner in corners]


def read_ply(path: Path) -> RawMesh:
    """PLY, ASCII or binary, through trimesh; a file with fewer faces than its header announces is an error."""
    return _with_announced_faces(path, _read_with_trimesh(path), _announced_ply_faces(path))


def read_off(path: Path) -> RawMesh:
    """OFF through trimesh; a file with fewer faces than its header announces is an error."""
    mesh = _with_announced_faces(path, _read_with_trimesh(path), _announced_off_faces(path))
    mesh.face_colors = _off_face_colors(path, len(mesh.faces))  # trimesh leaves them out
    return mesh


def read_gltf(path: Path) -> RawMesh:
    """GLB and glTF through trimesh: all meshes of the scene in its frame; linear COLOR_0 becomes display values."""
    mesh = _read_with_trimesh(path)
    if mesh.vertex_colors is not None:
        mesh.vertex_colors = srgb_from_linear(mesh.vertex_colors)
    return mesh


def _read_with_trimesh(path: Path) -> RawMesh:
    """All meshes of the file in one, vertices and faces as stored."""
    import trimesh

    # trimesh's readers signal damage with whatever their parsing runs into, missing optional modules included.
    try:
        scene = trimesh.load_scene(str(path), process=False, skip_materials=True)
        parts = [_placed(scene, node) for node in scene.graph.nodes_geometry]
    except Exception as error:
        detail = (str(error) or type(error).__name__).splitlines()[0]
        if isinstance(error, ImportError):  # it wanted a module that guesses encodings
            detail = "neither its binary form nor text"
        kind = path.suffix[1:].upper()
        raise InputError(
            f"mesh {path}: cannot be read as {kind} ({detail}); is the file cut short? Export it again"
        ) from error
    return _concatenated(parts)


def _placed(scene: "trimesh.Scene", node: str) -> RawMesh:
    import trimesh
    from trimesh.visual import ColorVisuals

    transform, name = scene.graph[node]
    geometry = scene.geometry[name]
    vertices = trimesh.transform_points(geometry.vertices, transform)
    if not isinstance(geometry, trimesh.Trimesh):
        return RawMesh(vertices, np.zeros((0, 3), dtype=np.int64))
    visual = geometry.visual
    if not isinstance(visual, ColorVisuals):  # a texture
        return RawMesh(vertices, np.asarray(geometry.faces))
    face_colors = np.asarray(visual.face_colors)[:, :3] / 255 if visual.kind == "face" else _ply_face_colors(geometry)
    per_vertex = visual.kind == "vertex" and face_colors is None
    return RawMesh(
        vertices,
        np.asarray(geometry.faces),
        face_colors=face_colors,
        vertex_colors=np.asarray(visual.vertex_colors)[:, :3] / 255 if per_vertex else None,
    )


def _ply_face_colors(mesh: "trimesh.Trimesh") -> np.ndarray | None:
    """The colours that trimesh forgets where vertices have some too."""
    from trimesh.visual.color import to_rgba

    element = mesh.metadata.get("_ply_raw", {}).get("face", {})
    channels = [element["data"][name] for name in ("red", "green", "blue") if name in element.get("properties", {})]
    if len(channels) < 3 or len(channels[0]) != len(mesh.faces):
        return None
    return to_rgba(np.column_stack(channels))[:, :3] / 255


def _concatenated(parts: list[RawMesh]) -> RawMesh:
    def joined(arrays: list[np.ndarray | None]) -> np.ndarray | None:
        present = [array for array in arrays if array is not None]
        return np.concatenate(present) if present and len(present) == len(arrays) else None

    if not parts:
        return RawMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    return RawMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)]),
        joined([part.face_colors for part in parts]),
        joined([part.vertex_colors for part in parts]),
    )


def _with_announced_faces(path: Path, mesh: RawMesh, announced: int) -> RawMesh:
    if len(mesh.faces) < announced:
        raise InputError(
            f"mesh {path}: {len(mesh.faces)} faces where its header announces {announced};"
            " the file is cut short or has faces with fewer than three corners: export it again"
        )
    mesh.file_faces = announced
    return mesh


def _announced_ply_faces(path: Path) -> int:
    with open(path, "rb") as file:
        for line in file:
            words = line.split()
            if words[:2] == [b"element", b"face"]:
                return int(words[2])
            if words[:1] == [b"end_header"]:
                break
    return 0


def _announced_off_faces(path: Path) -> int:
    with open(path, encoding="utf-8", errors="replace") as file:
        words = [word for line in file for word in line.split("#")[0].split()][:4]
    return int(words[2])


def _off_face_colors(path: Path, count: int) -> np.ndarray | None:
    """Colours behind the corners of every face, as whole numbers up to 255 or fractions; None if a face has none."""
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = [words for line in file if (words := line.split("#")[0].split())]
    rows = lines[-count:]
    if not rows or any(row[0] != "3" or len(row) < 7 for row in rows):
        return None
    colors = np.array([[float(word) for word in row[4:7]] for row in rows])
    whole = all(word.isdigit() for row in rows for word in row[4:7])
    return np.clip(colors / 255 if whole else colors, 0, 1)


READERS: dict[str, Callable[[Path], RawMesh]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".stl": _read_with_trimesh,
    ".off": read_off,
}
"""Readers by suffix, lower case."""
