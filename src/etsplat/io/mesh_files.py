"""Triangle meshes on disk: PLY, OBJ, GLB, STL and OFF in; every kind of file with colours at vertices out."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io._mesh_readers import READERS, RawMesh
from etsplat.io.paths import kind_of, path_remedy
from etsplat.io.surface import Surface
from etsplat.io.surface_files import save_surface, writer_of


@dataclass(frozen=True)
class MeshFile:
    """A triangle mesh as files hold it.

    Attributes:
        vertices: (V, 3) float32, finite.
        faces: (F, 3) int64 indices into `vertices`.
        face_colors: (F, 3) float32 in [0, 1] as displayed (sRGB), or None.
        vertex_colors: (V, 3) float32 in [0, 1] as displayed (sRGB), or None.
        notes: one sentence for each repair made while reading (polygons cut into triangles, faces dropped).
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int64[Tensor, "F 3"]
    face_colors: Float[Tensor, "F 3"] | None = None
    vertex_colors: Float[Tensor, "V 3"] | None = None
    notes: tuple[str, ...] = ()


def load_mesh(path: Path | str) -> MeshFile:
    """Read a triangle mesh.

    Polygons are cut into triangles, faces of zero area, repeated faces and vertices without a face are dropped; each
    of these is told in `notes`. Positions and connectivity are otherwise as in the file: no welding.

    Args:
        path: .ply, .obj, .glb, .gltf, .stl or .off.

    Returns:
        The mesh, with whatever colours per face or vertex the file has (textures are ignored).

    Raises:
        InputError: the file is missing, empty, cut short, of another kind, has no faces, non-finite vertices, or
            indices out of range.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"mesh {path}: no such file; {path_remedy(path)}")
    if path.is_dir():
        raise InputError(f"mesh {path}: is a folder; name a mesh file ({', '.join(READERS)})")
    if kind_of(path) not in READERS:
        raise InputError(f"mesh {path}: unknown kind of file; convert it to one of {', '.join(READERS)}")
    if path.stat().st_size == 0:
        raise InputError(f"mesh {path}: the file is empty; export it again")
    raw = READERS[kind_of(path)](path)
    _check(path, raw)
    return _clean(path, raw)


def save_mesh(
    path: Path | str,
    vertices: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    face_colors: Float[Tensor, "F 3"] | None = None,
    *,
    vertex_colors: Float[Tensor, "V 3"] | None = None,
    split: bool = False,
) -> None:
    """Write a triangle mesh with colours per face or per vertex. Atomic.

    Of colours per face, each vertex gets the area-weighted mean of its faces'; with `split` no vertex is shared, and so
    its face's exact colour. OBJ and GLB know no others, and many programs read no others from PLY, which has both.
    Colours are display values (sRGB) in PLY and OBJ; glTF wants linear light, so GLB is converted, and its material is
    unlit: a viewer shows the colours of the render.

    Args:
        path: ends in .ply, .obj or .glb.
        vertices: finite positions.
        faces: indices into `vertices`.
        face_colors: display values in [0, 1] (others are clamped); at most one of the two kinds of colours.
        vertex_colors: the same for vertices.
        split: unshare all vertices.

    Raises:
        ValueError: wrong shapes, indices out of range, or values that are not finite.
        InputError: the file cannot be written.
    """
    path = Path(path)
    writer_of(path, holding="vertex_colors")
    _check_arguments(vertices, faces, face_colors, vertex_colors)
    v = vertices.detach().to("cpu", torch.float64).numpy()
    f = faces.detach().to("cpu", torch.int64).numpy()
    per_face, per_vertex = _display_values(face_colors), _display_values(vertex_colors)
    if split:
        per_vertex = None if per_vertex is None else per_vertex[f].reshape(-1, 3)
        v, f = v[f].reshape(-1, 3), np.arange(f.size).reshape(-1, 3)
    if per_face is not None:
        per_vertex = np.repeat(per_face, 3, axis=0) if split else _vertex_means(v, f, per_face)
    save_surface(path, Surface(v.astype(np.float32), f, per_vertex, per_face, name=path.stem))


def weld_vertices(mesh: MeshFile) -> MeshFile:
    """Merge vertices at exactly equal positions (as STL and texture seams leave them); the first one's colour stays.

    Faces that collapse by this are dropped, with a note.
    """
    unique, first, inverse = np.unique(mesh.vertices.numpy(), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # keep the file's order
    rank = np.empty(len(unique), dtype=np.int64)
    rank[order] = np.arange(len(unique))
    keep = torch.from_numpy(first[order])
    welded = replace(
        mesh,
        vertices=mesh.vertices[keep],
        faces=torch.from_numpy(rank[inverse.reshape(-1)])[mesh.faces],
        vertex_colors=None if mesh.vertex_colors is None else mesh.vertex_colors[keep],
    )
    f = welded.faces
    whole = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    return _drop_faces(welded, ~whole, "that collapsed when vertices were merged")


def _check(path: Path, raw: RawMesh) -> None:
    """Raise InputError for what cannot be repaired."""
    if len(raw.vertices) == 0:
        raise InputError(f"mesh {path}: no vertices; export it again")
    if len(raw.faces) == 0:
        raise InputError(
            f"mesh {path}: {len(raw.vertices)} points but no faces; mesh the point cloud first (e.g. in MeshLab)"
        )
    with np.errstate(over="ignore"):
        bad = np.flatnonzero(~np.isfinite(raw.vertices.astype(np.float32)).all(axis=1))
    if len(bad):
        raise InputError(
            f"mesh {path}: {len(bad)} of {len(raw.vertices)} vertices are not finite (first: {bad[0]}); repair the mesh"
        )
    outside = (raw.faces < 0) | (raw.faces >= len(raw.vertices))
    if outside.any():
        face, corner = np.argwhere(outside)[0]
        raise InputError(
            f"mesh {path}: face {face} uses vertex {raw.faces[face, corner]}, but there are"
            f" {len(raw.vertices)} vertices; is the file cut short? Export it again"
        )


def _clean(path: Path, raw: RawMesh) -> MeshFile:
    """Float32 and int64 tensors; faces without area, repeated faces and loose vertices dropped."""

    def colors(values: np.ndarray | None) -> Tensor | None:
        return None if values is None else torch.from_numpy(np.ascontiguousarray(values[:, :3], dtype=np.float32))

    mesh = MeshFile(
        torch.from_numpy(np.ascontiguousarray(raw.vertices, dtype=np.float32)),
        torch.from_numpy(np.ascontiguousarray(raw.faces, dtype=np.int64)),
        colors(raw.face_colors),
        colors(raw.vertex_colors),
    )
    if raw.file_faces is not None and len(raw.faces) > raw.file_faces:
        mesh = replace(mesh, notes=(f"{raw.file_faces} polygons were cut into {len(raw.faces)} triangles",))
    corners = mesh.vertices[mesh.faces].double()
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mesh = _drop_faces(mesh, (normals == 0).all(dim=1), "of zero area")
    _, first = np.unique(mesh.faces.sort(dim=1).values.numpy(), axis=0, return_index=True)
    repeated = torch.ones(len(mesh.faces), dtype=torch.bool)
    repeated[torch.from_numpy(first)] = False
    mesh = _drop_faces(mesh, repeated, "that repeat another face")
    if len(mesh.faces) == 0:
        raise InputError(f"mesh {path}: all {len(raw.faces)} faces have zero area; export it again")
    return _drop_loose_vertices(mesh)


def _drop_faces(mesh: MeshFile, drop: Tensor, which: str) -> MeshFile:
    count = int(drop.sum())
    if count == 0:
        return mesh
    return replace(
        mesh,
        faces=mesh.faces[~drop],
        face_colors=None if mesh.face_colors is None else mesh.face_colors[~drop],
        notes=(*mesh.notes, f"{count} of {len(drop)} faces {which} were dropped"),
    )


def _drop_loose_vertices(mesh: MeshFile) -> MeshFile:
    used = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    used[mesh.faces.reshape(-1)] = True
    if bool(used.all()):
        return mesh
    index = used.cumsum(0) - 1
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=index[mesh.faces],
        vertex_colors=None if mesh.vertex_colors is None else mesh.vertex_colors[used],
        notes=(*mesh.notes, f"{int((~used).sum())} vertices without a face were dropped"),
    )


def _display_values(colors: Tensor | None) -> np.ndarray | None:
    return None if colors is None else colors.detach().to("cpu", torch.float64).clamp(0, 1).numpy()


def _check_arguments(vertices: Tensor, faces: Tensor, face_colors: Tensor | None, vertex_colors: Tensor | None) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices: expected shape (V, 3), got {tuple(vertices.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise ValueError(f"faces: expected shape (F, 3) with F > 0, got {tuple(faces.shape)}")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise ValueError(f"faces: expected indices in [0, {len(vertices)})")
    if face_colors is not None and vertex_colors is not None:
        raise ValueError("face_colors, vertex_colors: expected one of them at most, got both")
    for name, colors, count in (
        ("face_colors", face_colors, len(faces)),
        ("vertex_colors", vertex_colors, len(vertices)),
    ):
        if colors is not None and tuple(colors.shape) != (count, 3):
            raise ValueError(f"{name}: expected shape {(count, 3)}, got {tuple(colors.shape)}")
    for name, values in (("vertices", vertices), ("face_colors", face_colors), ("vertex_colors", vertex_colors)):
        if values is not None and not bool(torch.isfinite(values).all()):
            raise ValueError(f"{name}: expected finite values, got NaN or Inf")


def _vertex_means(v: np.ndarray, f: np.ndarray, face_colors: np.ndarray) -> np.ndarray:
    """(V, 3) area-weighted mean of the colours of each vertex's faces (plain mean where all areas are zero)."""
    corners = v[f]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    areas = np.maximum(areas, 1e-12 * max(areas.max(), 1e-300))
    total = np.zeros((len(v), 3))
    weight = np.zeros(len(v))
    for corner in range(3):
        np.add.at(total, f[:, corner], face_colors * areas[:, None])
        np.add.at(weight, f[:, corner], areas)
    return total / np.where(weight > 0, weight, 1)[:, None]
