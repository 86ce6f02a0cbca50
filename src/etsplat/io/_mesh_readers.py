"""Mesh readers by suffix. OBJ and OFF have their own, which keep the file's connectivity; the others use trimesh.

trimesh is imported where it is used: it takes half a second, which runs without such files need not wait for.
"""

import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from etsplat.core.errors import InputError
from etsplat.io._gltf import (
    COLOR,
    check_gltf,
    fractions,
    is_compressed,
    join_gltf,
    keep_colors,
    refuse_unread,
    split_gltf,
    unmoved_note,
    unpack,
)
from etsplat.io._materials import GltfMaterials, obj_texture, ply_texture
from etsplat.io._ply_polygons import with_triangles
from etsplat.io._polygons import cut_concave
from etsplat.io.meshopt import load_meshopt
from etsplat.io.paths import kind_of
from etsplat.io.ply_tables import COLORS, read_ply_comments, with_usual_colors
from etsplat.io.srgb import srgb_from_linear
from etsplat.io.textures import Texture

if TYPE_CHECKING:
    import trimesh

Corners = tuple[int, int, int]

_MOST_VERTICES = 1 << 26
"""Of all copies of meshes that the nodes of a glTF scene place."""


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
    texture: Texture | None = None
    notes: list[str] = field(default_factory=list)
    """What of the file is left out."""


def read_obj(path: Path) -> RawMesh:
    """Positions (with the colours that may follow them), faces, and the texture of a Wavefront OBJ."""
    rows: list[list[float]] = []
    uvs: list[list[float]] = []
    face_uvs: list[Corners] = []
    libraries: list[str] = []
    materials, material, face_materials = {"": 0}, 0, []
    faces: list[Corners] = []
    polygons: list[tuple[int, int]] = []
    file_faces = 0
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for number, line in _statements(file):
            words = line.split()
            try:
                if words[:1] == ["v"]:
                    if len(words) not in (4, 5, 7, 8):  # x y z [w] [r g b] (with alpha in some exporters)
                        raise ValueError(f"a vertex with {len(words) - 1} numbers")
                    values = [float(word) for word in words[1:]]
                    rows.append(values[:6] if len(values) >= 6 else values[:3])
                elif words[:1] == ["f"]:
                    corners = [int(word.split("/", 1)[0]) for word in words[1:]]
                    if 0 in corners:
                        raise ValueError("vertex number 0; they count from 1")
                    cut = _fan([corner - 1 if corner > 0 else len(rows) + corner for corner in corners])
                    if len(cut) > 1:
                        polygons.append((len(faces), len(corners)))
                    faces += cut
                    file_faces += 1
                    if libraries:
                        face_uvs += _fan([_uv_number(word, len(uvs)) for word in words[1:]])
                        face_materials += [material] * len(cut)
                elif words[:1] == ["vt"]:
                    uvs.append(_place(words[1:3], wanted=bool(libraries)))
                elif words[:1] == ["usemtl"]:
                    material = materials.setdefault(line.split(None, 1)[1].strip() if words[1:] else "", len(materials))
                elif words[:1] == ["mtllib"] and words[1:]:
                    libraries.append(line.split(None, 1)[1].strip())
            except ValueError as error:
                raise InputError(
                    f"mesh {path}: line {number} is not valid OBJ ({error}); is the file cut short? Export it again"
                ) from error
    table = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
    colored = len(rows) > 0 and all(len(row) == 6 for row in rows)
    colors = np.array([row[3:] for row in rows], dtype=np.float64) if colored else None
    triangles, numbers = np.array(faces, dtype=np.int64).reshape(-1, 3), np.array(face_uvs).reshape(-1, 3)
    cut_concave(table, triangles, polygons, *([numbers] if len(numbers) == len(triangles) else []))
    mesh = RawMesh(table, triangles, vertex_colors=colors, file_faces=file_faces)
    if libraries and len(face_uvs) < len(faces):
        mesh.notes.append("its materials are named behind its faces; they are left out")
    elif len(face_uvs) > 0:
        if numbers.max() >= len(uvs):
            raise InputError(
                f"mesh {path}: a face uses texture coordinate {int(numbers.max()) + 1}, but there are {len(uvs)};"
                " is the file cut short? Export it again"
            )
        table = np.array(uvs, dtype=np.float64).reshape(-1, 2)
        if not (np.abs(table) < np.finfo(np.float32).max).all():
            raise InputError(f"mesh {path}: texture coordinates that are not finite; export it again")
        mesh.texture, plain, mesh.notes = obj_texture(
            path, libraries, list(materials), np.array(face_materials), table, numbers
        )
        mesh.face_colors = plain if mesh.vertex_colors is None else None
    return mesh


def _statements(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    """The lines of an OBJ with their numbers; one that ends in a backslash goes on in the next, but no comment does."""
    number, begun = 0, ""
    for number, line in enumerate(lines, 1):
        if line.endswith("\\\n") and not (begun or line).startswith("#"):
            begun += f"{line[:-2]} "
        else:
            yield number, begun + line if begun else line
            begun = ""
    if begun:
        yield number, begun


def _place(words: list[str], *, wanted: bool) -> list[float]:
    """A texture coordinate. One that is no number is NaN where nothing has named a material yet."""
    try:
        if not words:
            raise ValueError("a texture coordinate without a number")
        return [float(word) for word in [*words, "0"][:2]]
    except ValueError:
        if wanted:
            raise
        return [np.nan, np.nan]


def _uv_number(word: str, count: int) -> int:
    """The texture coordinate of a corner, from 0; -1 if it has none."""
    parts = word.split("/")
    number = int(parts[1]) if len(parts) > 1 and parts[1] else 0
    if number < -count:
        raise ValueError(f"texture coordinate {number} of {count}")
    return number - 1 if number >= 0 else count + number


def _fan(corners: list[int]) -> list[Corners]:
    """The triangles that a polygon is cut into."""
    if len(corners) < 3:
        raise ValueError(f"a face with {len(corners)} corners")
    if max(corners) > np.iinfo(np.int64).max or min(corners) < np.iinfo(np.int64).min:
        raise ValueError(f"a face of vertex {max(corners, key=abs)}")
    return [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]


def read_off(path: Path) -> RawMesh:
    """OFF. Colours behind the corners of every face are whole numbers up to 255 or fractions; vertices lose theirs."""
    with open(path, encoding="utf-8", errors="replace") as file:
        rows = [words for line in file if (words := line.split("#")[0].split())]
    faces: list[Corners] = []
    polygons: list[tuple[int, int]] = []
    tails: list[list[str]] = []
    try:
        if rows[0].pop(0) not in ("OFF", "COFF"):
            raise ValueError("its first word is not OFF")
        vertex_count, face_count = (int(word) for word in (rows.pop(0) or rows.pop(0))[:2])
        if min(vertex_count, face_count) < 0 or len(rows) < vertex_count + face_count:
            raise ValueError(f"{len(rows)} lines for {vertex_count} vertices and {face_count} faces")
        vertices = np.array([[float(word) for word in row[:3]] for row in rows[:vertex_count]], dtype=np.float64)
        vertices = vertices.reshape(vertex_count, 3)
        for row in rows[vertex_count : vertex_count + face_count]:
            behind = 1 + int(row[0])
            if len(row) < behind:
                raise ValueError(f"a face of {row[0]} corners with {len(row) - 1}")
            cut = _fan([int(word) for word in row[1:behind]])
            if len(cut) > 1:
                polygons.append((len(faces), len(cut) + 2))
            faces += cut
            tails += [row[behind : behind + 3]] * len(cut)
        colors = None
        if all(len(tail) == 3 for tail in tails):
            whole = all(word.isdigit() for tail in tails for word in tail)
            colors = np.array([[float(word) for word in tail] for tail in tails]) / (255 if whole else 1)
    except (ValueError, IndexError) as error:
        raise _unreadable(path, error) from error
    table = np.array(faces, dtype=np.int64).reshape(-1, 3)
    cut_concave(vertices, table, polygons)
    return RawMesh(vertices, table, face_colors=colors, file_faces=face_count)


def read_ply(path: Path) -> RawMesh:
    """PLY, ASCII or binary, through trimesh; a file with fewer faces than its header announces is an error.

    Polygons are cut before: trimesh reads no binary file of triangles and quads, and loses whose colours are whose.
    One picture is read with the places of corners in lists at faces, as MeshLab and we write it.
    """
    mesh = _read_with_trimesh(path, with_usual_colors(path, with_triangles(path)))
    with open(path, "rb") as file:
        header = [line.split() for line in file.read(1 << 16).split(b"end_header")[0].splitlines()]
    try:
        announced = next((int(words[2]) for words in header if words[:2] == [b"element", b"face"]), 0)
    except (ValueError, IndexError) as error:  # of lines that trimesh takes no notice of
        raise _unreadable(path, error) from error
    if len(mesh.faces) < announced:
        raise InputError(
            f"mesh {path}: {len(mesh.faces)} faces where its header announces {announced};"
            " the file is cut short or has faces with fewer than three corners: export it again"
        )
    mesh.file_faces = announced or None  # none of what has strips
    names = [line.removeprefix("TextureFile ") for line in read_ply_comments(path) if line.startswith("TextureFile ")]
    if names:
        mesh.texture, mesh.notes = ply_texture(path, names, len(mesh.faces))
    return mesh


def read_gltf(path: Path) -> RawMesh:
    """GLB and glTF through trimesh: all meshes of the scene in its frame; linear COLOR_0 becomes display values.

    Quantised and compressed arrays (KHR_mesh_quantization, EXT_meshopt_compression) are unpacked before.
    """
    try:
        data = check_gltf(path)
        document, binary = split_gltf(data)
        refuse_unread(path, document)
        unmoved = unmoved_note(path, document)
        compressed = is_compressed(document)
    except InputError:
        raise
    except Exception as error:
        raise _unreadable(path, error) from error
    if compressed:
        try:
            load_meshopt()
        except InputError as error:
            raise InputError(f"mesh {path}: {error}") from error
    try:
        materials = GltfMaterials(path, document, binary)
        changed = unpack(path, document, binary)
        if materials.wanted:
            materials.mark()
        changed = keep_colors(document) or materials.wanted or changed
        if changed:
            data = join_gltf(data, document)
    except Exception as error:
        raise _unreadable(path, error) from error
    mesh = _read_with_trimesh(path, data if changed else None, materials)
    if mesh.vertex_colors is not None:
        mesh.vertex_colors = srgb_from_linear(mesh.vertex_colors)
    mesh.notes = [*mesh.notes, *unmoved]
    return mesh


def _unreadable(path: Path, error: Exception) -> InputError:
    detail = (str(error) or type(error).__name__).splitlines()[0]
    if isinstance(error, ImportError):  # trimesh wanted a module that guesses encodings
        detail = "neither its binary form nor text"
    kind = path.suffix[1:].upper()
    return InputError(f"mesh {path}: cannot be read as {kind} ({detail}); is the file cut short? Export it again")


def _read_with_trimesh(path: Path, changed: bytes | None = None, materials: GltfMaterials | None = None) -> RawMesh:
    """All meshes of the file in one, vertices and faces as stored.

    Args:
        path: of the file.
        changed: what is read in its place.
        materials: of glTF, whose textures are read where there are any.
    """
    import trimesh
    from trimesh.resolvers import FilePathResolver

    textured = materials is not None and materials.wanted
    # trimesh's readers signal damage with whatever their parsing runs into, missing optional modules included.
    try:
        file = str(path) if changed is None else io.BytesIO(changed)
        scene = trimesh.load_scene(
            file,
            file_type=None if changed is None else kind_of(path)[1:],
            resolver=None if changed is None else FilePathResolver(str(path)),
            process=False,
            skip_materials=True,
        )
        nodes = scene.graph.nodes_geometry
        if sum(len(scene.geometry[scene.graph[node][1]].vertices) for node in nodes) > _MOST_VERTICES:
            raise ValueError(f"its {len(nodes)} nodes have more than {_MOST_VERTICES} vertices")
        parts = [_placed(scene, node) for node in nodes]
        texture, plain = _gltf_texture(scene, parts, materials) if textured and materials is not None else (None, None)
    except Exception as error:
        raise _unreadable(path, error) from error
    if not parts:
        return RawMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    vertex_colors = _joined([part.vertex_colors for part in parts])
    return RawMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)]),
        _joined([part.face_colors for part in parts]) if plain is None or vertex_colors is not None else plain,
        vertex_colors,
        texture=texture,
        notes=materials.pictures.notes if textured and materials is not None else [],
    )


def _gltf_texture(
    scene: "trimesh.Scene", parts: list[RawMesh], materials: GltfMaterials
) -> tuple[Texture | None, np.ndarray | None]:
    """Of the faces of all nodes; or the plain colours of these, which multiply colours of vertices in their parts."""
    images, corners = [], []
    for node, part in zip(scene.graph.nodes_geometry, parts, strict=True):
        if len(part.faces):
            attributes = scene.geometry[scene.graph[node][1]].vertex_attributes
            number, uvs = materials.uvs(attributes)
            if part.vertex_colors is not None:
                part.vertex_colors = part.vertex_colors * materials.factor(attributes)
            if materials.pictures.textured and not np.isfinite(uvs.astype(np.float32)).all():
                raise ValueError("texture coordinates that are not finite")
            images.append(np.full(len(part.faces), number))
            corners.append(uvs[part.faces])
    if not images:
        return None, None
    numbers = np.concatenate(images)
    return materials.pictures.texture(numbers, np.concatenate(corners)), materials.pictures.colors(numbers)


def _joined(colors: list[np.ndarray | None]) -> np.ndarray | None:
    present = [array for array in colors if array is not None]
    return np.concatenate(present) if len(present) == len(colors) else None


def _placed(scene: "trimesh.Scene", node: str) -> RawMesh:
    import trimesh
    from trimesh.visual import ColorVisuals

    transform, name = scene.graph[node]
    geometry = scene.geometry[name]
    vertices = trimesh.transform_points(geometry.vertices, transform)
    if not isinstance(geometry, trimesh.Trimesh):
        return RawMesh(vertices, np.zeros((0, 3), dtype=np.int64))
    faces = np.asarray(geometry.faces)
    if np.linalg.det(transform[:3, :3]) < 0:  # mirrored, as glTF has it: what was anticlockwise from outside still is
        faces = faces[:, ::-1]
    mesh, visual = RawMesh(vertices, faces), geometry.visual
    if isinstance(visual, ColorVisuals):  # and no texture
        mesh.face_colors = visual.face_colors[:, :3] / 255 if visual.kind == "face" else _ply_face_colors(geometry)
        if visual.kind == "vertex" and mesh.face_colors is None:
            mesh.vertex_colors = fractions(geometry.vertex_attributes.get(COLOR, visual.vertex_colors))[:, :3]
    if mesh.face_colors is not None and len(mesh.face_colors) != len(mesh.faces):
        raise ValueError(f"colours of {len(mesh.face_colors)} faces for {len(mesh.faces)}")
    return mesh


def _ply_face_colors(mesh: "trimesh.Trimesh") -> np.ndarray | None:
    """The colours that trimesh forgets where vertices have some too."""
    from trimesh.visual.color import to_rgba

    element = mesh.metadata.get("_ply_raw", {}).get("face", {})
    channels = [element["data"][name] for name in COLORS if name in element.get("properties", {})]
    if len(channels) < 3 or len(channels[0]) != len(mesh.faces):
        return None
    return to_rgba(np.column_stack(channels))[:, :3] / 255


READERS: dict[str, Callable[[Path], RawMesh]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".stl": _read_with_trimesh,
    ".off": read_off,
}
"""Readers by suffix, lower case."""
