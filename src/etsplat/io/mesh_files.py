"""Triangle meshes on disk: PLY, OBJ, GLB, STL and OFF in; whatever `etsplat.io.writers` writes out."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import check_memory, dense
from etsplat.io._mesh_readers import READERS, RawMesh
from etsplat.io.export_records import LED_BACK, read_record, transform_of_record
from etsplat.io.georeference import Georeference
from etsplat.io.paths import given_path, kind_of, path_remedy
from etsplat.io.textures import NormalMap, Texture
from etsplat.io.writers import (
    Compression,
    PictureKind,
    Surface,
    SurfaceNormals,
    SurfaceTexture,
    save_surface,
    writer_of,
)

_MOVED = 1e-4
"""Of a mesh's size: by so much at most 32 bits may move a vertex. A photo of a thousand pixels shows ten times that."""

_BRIGHTEST = 2.0
"""Of colours that are clamped: others are not from 0 to 1."""


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A triangle mesh as files hold it.

    Attributes:
        vertices: (V, 3) float32, finite.
        faces: (F, 3) int64 indices into `vertices`.
        face_colors: (F, 3) float32 in [0, 1] as displayed (sRGB), or None.
        vertex_colors: (V, 3) float32 in [0, 1] as displayed (sRGB), or None.
        notes: one sentence for each repair made while reading (polygons cut into triangles, faces dropped), and for
            what of its textures is left out.
        texture: pictures over the faces (OBJ with MTL, glTF, PLY), or None.

    Raises:
        ValueError: one of them is no tensor: `torch.from_numpy` makes one of an array.

    Example:
        >>> vertices, faces = etsplat.icosphere(1)
        >>> mesh = etsplat.MeshFile(vertices, faces, face_colors=torch.ones(len(faces), 3))
        >>> etsplat.save_mesh("sphere.ply", mesh.vertices, mesh.faces, mesh.face_colors)
    """

    __repr__ = short_repr

    vertices: Float[Tensor, "V 3"]
    faces: Int64[Tensor, "F 3"]
    face_colors: Float[Tensor, "F 3"] | None = None
    vertex_colors: Float[Tensor, "V 3"] | None = None
    notes: tuple[str, ...] = ()
    texture: Texture | None = None

    def __post_init__(self) -> None:
        for name in ("vertices", "faces", "face_colors", "vertex_colors"):
            if (array := getattr(self, name)) is not None:
                check_memory(name, array)

    def check(self) -> None:
        """Raises ValueError, naming the array, unless they are tensors of these shapes, finite, with faces in range."""
        _check_arrays(self.vertices, self.faces, self.face_colors, self.vertex_colors)


@usual_defaults()
def load_mesh(path: Path | str) -> MeshFile:
    """Read a triangle mesh.

    Polygons are cut into triangles, faces of zero area, repeated faces and vertices without a face are dropped; each
    of these is told in `notes`. Positions and connectivity are otherwise as in the file: no welding. One that `etsplat
    export` turned, scaled or moved stays so, with a note; `transform` of what it returned leads back.

    Args:
        path: .ply, .obj, .glb, .gltf, .stl or .off.

    Returns:
        The mesh, with whatever colours per face or vertex the file has, and its texture. Pictures must be PNG or JPEG
        in the folder of the file; those that cannot be used are left out, with a note.

    Raises:
        InputError: the file is missing, empty, cut short, of another kind, has no faces, non-finite vertices, or
            indices out of range; 32 bits would move its vertices by more than 1/10,000 of its size, as they are so far
            from the origin.

    Example:
        >>> etsplat.save_mesh("sphere.ply", *etsplat.icosphere(1))
        >>> etsplat.load_mesh("sphere.ply").faces.shape
        torch.Size([80, 3])
    """
    path = given_path("path", path)
    mesh = _clean(path, _read(path))
    with suppress(InputError):  # of a record that cannot be used; here it is for people alone
        if transform_of_record(path, read_record(path)).moves:
            note = "etsplat export turned, scaled or moved it: it lies as in the file, and not as the run that it is of"
            return replace(mesh, notes=(*mesh.notes, note))
    return mesh


def load_exported(path: Path) -> tuple[MeshFile, dict[str, Any]]:
    """A mesh as `load_mesh`, in the frame of the capture that `etsplat export` had it from; and what the file says.

    Raises:
        InputError: as `load_mesh`; the file's record of the export is damaged.
    """
    raw, record = _read(path), read_record(path)
    if (transform := transform_of_record(path, record)).moves:
        raw.vertices = transform.invert(torch.from_numpy(raw.vertices)).numpy()
        raw.notes = [*raw.notes, LED_BACK]
    return _clean(path, raw), record


def _read(path: Path) -> RawMesh:
    """What is in a file, with nothing in it that cannot be repaired."""
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
    return raw


def save_mesh(
    path: Path | str,
    vertices: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    face_colors: Float[Tensor, "F 3"] | None = None,
    *,
    vertex_colors: Float[Tensor, "V 3"] | None = None,
    texture: Texture | None = None,
    normal_map: NormalMap | None = None,
    mipmaps: bool = True,
    split: bool = False,
    world: Georeference | None = None,
    compress: Compression = "none",
    pictures: PictureKind = "png",
    record: Mapping[str, Any] | None = None,
) -> None:
    """Write a triangle mesh with colours per face or per vertex, or a texture. Atomic.

    Of colours per face, each vertex gets the area-weighted mean of its faces'; with `split` no vertex is shared, and so
    its face's exact colour. OBJ and GLB know no others, and many programs read no others from PLY, which has both.
    Colours are display values (sRGB) in PLY and OBJ; glTF wants linear light, so GLB is converted, and its material is
    unlit: a viewer shows the colours of the render.

    Args:
        path: ends in .ply, .obj or .glb.
        vertices: finite positions.
        faces: indices into `vertices`.
        face_colors: display values in [0, 1] (up to 2 they are clamped); at most one of the two kinds of colours.
        vertex_colors: the same for vertices.
        texture: one picture over all faces, in the place of colours; for GLB, and OBJ and PLY with a PNG beside them.
        normal_map: how light falls on the faces under the texture, for GLB alone, whose material then is lit.
        mipmaps: whether viewers of GLB may shrink the texture; not if its parts belong to faces apart.
        split: unshare all vertices.
        world: its offset is added to all vertices in float64: PLY holds doubles then, OBJ and OFF the digits, GLB has
            it as the translation of its nodes, which turn z to +y where that is up. Vertices are scaled already.
        compress: how GLB stores arrays: "none": 32 bits; "quantize": positions, coordinates and colours of 16 bits,
            normals of 8; "meshopt": those compressed, for which pip install 'etsplat[compress]' is needed.
        pictures: how GLB stores the texture and what lies beside it.
        record: how the mesh was made, by name, as JSON has it; OFF has no room for it.

    Raises:
        ValueError: wrong shapes, indices out of range, or values that are not finite.
        InputError: the file cannot be written; a package is missing.

    Example:
        >>> vertices, faces = etsplat.icosphere(1)
        >>> etsplat.save_mesh("ball.ply", vertices, faces, face_colors=torch.rand(len(faces), 3))
        >>> len(etsplat.load_mesh("ball.ply").faces)
        80
    """
    path = given_path("path", path)
    if compress != "none" or pictures != "png":
        writer_of(path, holding="compressed")
    writer_of(path, holding="vertex_colors" if texture is None else "texture" if normal_map is None else "normals")
    if texture is not None and (face_colors is not None or vertex_colors is not None):
        raise ValueError("texture: expected no colours beside it")
    if face_colors is not None and vertex_colors is not None:
        raise ValueError("face_colors, vertex_colors: expected one of them at most, got both")
    _check_arrays(vertices, faces, face_colors, vertex_colors)
    v, f = dense(vertices).to("cpu", torch.float64).numpy(), dense(faces).to("cpu", torch.int64).numpy()
    per_face = None if face_colors is None else _display_values(face_colors)
    per_vertex = None if vertex_colors is None else _display_values(vertex_colors)
    if split:
        per_vertex = None if per_vertex is None else per_vertex[f].reshape(-1, 3)
        v, f = v[f].reshape(-1, 3), np.arange(f.size).reshape(-1, 3)
    if per_face is not None:
        per_vertex = np.repeat(per_face, 3, axis=0) if split else _vertex_means(v, f, per_face)
    skin = None if texture is None else _surface_texture(texture, len(faces), mipmaps, normal_map, pictures)
    said = {} if record is None else {"record": record, "comment": "etsplat mesh"}
    more: dict[str, Any] = {"name": path.stem, "texture": skin, "compress": compress, **said, **_far(path, world)}
    save_surface(path, Surface(v.astype(np.float32), f, per_vertex, per_face, **more))


def _surface_texture(
    texture: Texture, faces: int, mipmaps: bool, normal_map: NormalMap | None, kind: PictureKind
) -> SurfaceTexture:
    """As writers take it, whose coordinates count from the top.

    Raises:
        ValueError: it has several pictures, or is that of another number of faces.
    """
    picture = texture.picture()
    if picture is None or len(texture.corner_uvs) != faces:
        given = f"{len(texture.face_images.unique())} over {len(texture.corner_uvs)}"
        raise ValueError(f"texture: expected one picture over {faces} faces, got {given}")
    uvs = texture.corner_uvs.detach().cpu().numpy().astype(np.float64)
    given = {} if normal_map is None else {name: value for name, value in vars(normal_map).items() if value is not None}
    relief = SurfaceNormals(**{name: value.cpu().numpy() for name, value in given.items()}) if given else None
    from_above = np.stack([uvs[..., 0], 1 - uvs[..., 1]], axis=-1)
    return SurfaceTexture(picture.cpu().numpy(), from_above, mipmaps, relief, kind)


def save_triangles(
    path: Path | str,
    vertices: Float[Tensor, "N 3 3"],
    colors: Float[Tensor, "N C"] | Float[Tensor, "N 3 C"],
    *,
    weld: bool = False,
    numbers: Mapping[str, Float[Tensor, " N"]] | None = None,
    comment: str | None = None,
    record: Mapping[str, Any] | None = None,
    sky: Bool[Tensor, " N"] | None = None,
    world: Georeference | None = None,
    compress: Compression = "none",
) -> None:
    """Write separate triangles, each or each of its corners in exactly its colour, as other programs read them. Atomic.

    OBJ and GLB know only colours of vertices, and Blender reads no others from PLY: PLY has them twice, at its vertices
    and at its faces. Colours are display values (sRGB); glTF wants linear light, so GLB is converted, and its material
    is unlit. Colours have 8 bits in PLY and OFF.

    Args:
        path: ends in what a module of `etsplat.io.writers` writes: .ply, .obj, .off or .glb.
        vertices: (N, 3, 3) finite positions.
        colors: (N, 3), or (N, 4) with alpha, which files without room for it leave out; in [0, 1] (others are clamped).
            (N, 3, 3) or (N, 3, 4) of each corner: faces then have their means.
        weld: triangles share vertices at equal positions, where their colours are equal too
            (in files without colours at vertices: all of them).
        numbers: further values per face, by name; only PLY has room for them.
        comment: a line of text; only PLY has room for it.
        record: how the triangles were made, by name, as JSON has it; OFF has no room for it.
        sky: which triangles are an object of their own, the sky, to be seen from the side from which their corners run
            counterclockwise; neither all nor none. Only OBJ and GLB have room for more than one object.
        world: as of `save_mesh`.
        compress: so.

    Raises:
        ValueError: another suffix or wrong shapes; a sky where there is no room for it.
        InputError: the file cannot be written.
    """
    path = given_path("path", path)
    writer_of(path, holding=None if sky is None else "objects")
    if compress != "none":
        writer_of(path, holding="compressed")
    far = _far(path, world)
    N = len(vertices)
    if vertices.shape[1:] != (3, 3) or colors.shape not in ((N, 3), (N, 4), (N, 3, 3), (N, 3, 4)):
        expected = "(N, 3, 3), (N, 3|4) or (N, 3, 3|4)"
        raise ValueError(f"vertices, colors: expected {expected}; got {vertices.shape}, {colors.shape}")
    if sky is not None and not 0 < int(sky.sum()) < len(vertices):
        raise ValueError(f"sky: expected some of {len(vertices)} triangles, got {int(sky.sum())}")
    points, tones = vertices.detach().cpu().numpy().astype(np.float32), _display_values(colors)
    extra = {name: value.detach().cpu().numpy() for name, value in (numbers or {}).items()}
    rows = np.ones(len(points), dtype=bool) if sky is None else ~sky.cpu().numpy()
    scene = replace(_triangles(path, points[rows], tones[rows], weld=weld), **far)
    apart = None if sky is None else replace(_triangles(path, points[~rows], tones[~rows], weld=weld), **far)
    extra = {name: value[rows] for name, value in extra.items()}
    said = {"comment": comment, "name": path.stem, "record": record or {}, "compress": compress}
    save_surface(path, replace(scene, numbers=extra, sky=apart, **said))


def _far(path: Path, world: Georeference | None) -> dict[str, Any]:
    """What a surface has to know of its place in the world."""
    if world is None:
        return {}
    writer_of(path, holding="offset")
    return {"offset": np.array(world.offset, dtype=np.float64), "z_up": world.up == "z"}


def _triangles(path: Path, corners: np.ndarray, colors: np.ndarray, *, weld: bool) -> Surface:
    """Separate triangles as a kind of file has room for them; colours of them, or of their corners."""
    points, faces = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
    by_corner = colors if colors.ndim == 3 else np.repeat(colors[:, None], 3, axis=1)
    face_colors = colors.mean(axis=1) if colors.ndim == 3 else colors
    point_colors = by_corner.reshape(len(points), -1) if "vertex_colors" in writer_of(path).HOLDS else None
    if weld:
        keys = points if point_colors is None else np.hstack([points, point_colors.astype(np.float32)])
        kept, index = _first_of_equal(keys)
        points, faces = points[kept], index.reshape(-1, 3)
        point_colors = None if point_colors is None else point_colors[kept]
    return Surface(points, faces, point_colors, face_colors)


def weld_vertices(mesh: MeshFile) -> MeshFile:
    """Merge vertices at exactly equal positions (as STL and texture seams leave them); the first one's colour stays.

    Faces that collapse by this are dropped, with a note.
    """
    kept, index = _first_of_equal(mesh.vertices.numpy())
    welded = replace(
        mesh,
        vertices=mesh.vertices[kept],
        faces=torch.from_numpy(index)[mesh.faces],
        vertex_colors=None if mesh.vertex_colors is None else mesh.vertex_colors[kept],
    )
    collapsed = (welded.faces == welded.faces.roll(-1, dims=1)).any(dim=1)
    return _drop_faces(welded, collapsed, "that collapsed when vertices were merged")


def _first_of_equal(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which rows are the first of those equal to them, in the file's order; and each row's number among these."""
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return first[order], rank[inverse.reshape(-1)]


def _check(path: Path, raw: RawMesh) -> None:
    """Raise InputError for what cannot be repaired."""
    if len(raw.vertices) == 0:
        raise InputError(f"mesh {path}: no vertices; export it again")
    if len(raw.faces) == 0:
        raise InputError(
            f"mesh {path}: {len(raw.vertices)} points but no faces; mesh the point cloud first (e.g. in MeshLab)"
        )
    if raw.vertices.shape[1:] != (3,):
        raise InputError(f"mesh {path}: vertices of {raw.vertices.shape[1]} numbers, not 3; export it again")
    named = (("vertices", raw.vertices), ("face colours", raw.face_colors), ("vertex colours", raw.vertex_colors))
    for name, values in ((name, values) for name, values in named if values is not None):
        with np.errstate(over="ignore"):
            bad = np.flatnonzero(~np.isfinite(values.astype(np.float32)).all(axis=1))
        if len(bad):
            raise InputError(
                f"mesh {path}: {len(bad)} of {len(values)} {name} are not finite (first: {bad[0]}); repair the mesh"
            )
    outside = (raw.faces < 0) | (raw.faces >= len(raw.vertices))
    if outside.any():
        face, corner = np.argwhere(outside)[0]
        raise InputError(
            f"mesh {path}: face {face} uses vertex {raw.faces[face, corner]}, but there are"
            f" {len(raw.vertices)} vertices; is the file cut short? Export it again"
        )


def _check_near(path: Path, vertices: np.ndarray) -> None:
    """Raise InputError where 32 bits do not hold what 64 do, as coordinates of maps."""
    size, moved = np.ptp(vertices, axis=0).max(), np.abs(vertices.astype(np.float32) - vertices).max()
    if size > 0 and moved > _MOVED * size:
        x, y, z = vertices.mean(axis=0)
        raise InputError(
            f"mesh {path}: its coordinates are too far from the origin for its size: it is {size:.3g} across about"
            f" ({x:.8g}, {y:.8g}, {z:.8g}), where 32 bits move vertices by up to {moved:.2g}; subtract an offset from"
            " its vertices, so that it is near the origin"
        )


def _clean(path: Path, raw: RawMesh) -> MeshFile:
    """Float32 and int64 tensors; faces without area, repeated faces and loose vertices dropped."""

    def colors(values: np.ndarray | None) -> Tensor | None:
        return None if values is None else torch.from_numpy(values.clip(0, 1).astype(np.float32))

    _check_near(path, raw.vertices[np.unique(raw.faces)].astype(np.float64))
    mesh = MeshFile(
        torch.from_numpy(np.ascontiguousarray(raw.vertices, dtype=np.float32)),
        torch.from_numpy(np.ascontiguousarray(raw.faces, dtype=np.int64)),
        colors(raw.face_colors),
        colors(raw.vertex_colors),
        notes=tuple(raw.notes),
        texture=raw.texture,
    )
    if raw.file_faces is not None and len(raw.faces) > raw.file_faces:
        mesh = replace(mesh, notes=(*mesh.notes, f"{raw.file_faces} polygons were cut into {len(raw.faces)} triangles"))
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
        texture=None if mesh.texture is None else mesh.texture.keep(~drop),
        notes=(*mesh.notes, f"{count} of {len(drop)} faces {which} were dropped"),
    )


def _drop_loose_vertices(mesh: MeshFile) -> MeshFile:
    used, faces = mesh.faces.unique(return_inverse=True)
    loose = len(mesh.vertices) - len(used)
    if loose == 0:
        return mesh
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=faces,
        vertex_colors=None if mesh.vertex_colors is None else mesh.vertex_colors[used],
        notes=(*mesh.notes, f"{loose} vertices without a face were dropped"),
    )


def _display_values(colors: Tensor) -> np.ndarray:
    return colors.detach().to("cpu", torch.float64).clamp(0, 1).numpy()


def _check_arrays(vertices: Tensor, faces: Tensor, face_colors: Tensor | None, vertex_colors: Tensor | None) -> None:
    tables = {"vertices": (vertices, vertices), "faces": (faces, faces)}
    tables |= {} if face_colors is None else {"face_colors": (face_colors, faces)}
    tables |= {} if vertex_colors is None else {"vertex_colors": (vertex_colors, vertices)}
    for name, (values, _) in tables.items():
        check_memory(name, values)
    for name, (values, rows) in tables.items():
        wanted = (*rows.shape[:1], 3)
        if tuple(values.shape) != wanted:
            raise ValueError(f"{name}: expected shape {wanted}, got {tuple(values.shape)}")
        if not bool(torch.isfinite(values).all()):
            raise ValueError(f"{name}: expected finite values, got NaN or Inf")
        if name.endswith("colors") and (not values.is_floating_point() or bool((values > _BRIGHTEST).any())):
            raise ValueError(f"{name}: expected floating-point display values in [0, 1]; divide by 255 what is to 255")
    if faces.is_floating_point():
        raise ValueError(f"faces: expected whole numbers, got {faces.dtype}")
    if len(faces) == 0 or int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise ValueError(f"faces: expected indices in [0, {len(vertices)}), and at least one face")


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
