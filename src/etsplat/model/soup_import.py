"""Soups from files of other programs: Triangle Splatting's state, Gaussian scenes, meshes; and our own exports."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.harmonics import MAX_DEGREE, SH_CONSTANT
from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.rasterization import SOUP_SIGMA_FLOOR
from etsplat.io.export_records import LED_BACK, damaged, read_record, transform_of_record
from etsplat.io.mesh_files import READERS, load_exported
from etsplat.io.opaque_files import holds_opaque, load_opaque
from etsplat.io.paths import given_path, kind_of
from etsplat.io.ply_tables import COLORS, CORNERS, columns, read_ply_header, read_ply_tables
from etsplat.io.tensors import read_state_dict
from etsplat.io.textures import Texture
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.soup_compact import open_compact
from etsplat.model.triangle_soup import GEOREFERENCE_NOTE, UP_NOTE, TriangleSoup

GAUSSIAN_SIGMA = 1.0
"""With it the elastic kernel is exp(-x^2): the profile of a Gaussian."""

GAUSSIAN_INRADIUS = math.sqrt(2 * math.pi / (3 * math.sqrt(3)))
"""Inradius, in standard deviations, at which a triangle of that kernel covers the area of the Gaussian."""

_SPREAD = 4
"""Parts of each edge: of a face there are so many rows of points, where its texture is looked at."""

_KINDS = (".safetensors", ".etz", ".pt", *READERS)
"""Of files that hold triangles."""

_TS_KEYS = ("triangles_points", "opacity", "sigma", "features_dc", "features_rest")


def load_soup(path: Path | str, tell: Callable[[str], None] = lambda text: None) -> TriangleSoup:
    """Read triangles from any file that holds some.

    Meshes keep the colours of their corners, as other programs interpolate them, where they are drawn opaque; of a
    texture those that come nearest to it.

    Args:
        path: `.safetensors` of `etsplat train`, its opaque mesh too; `.etz` of `etsplat export`; `.pt` of Triangle
            Splatting (`point_cloud_state_dict.pt`); `.ply` that `etsplat export` wrote, of a Gaussian scene or of a
            mesh; `.obj`, `.off`, `.glb`, `.gltf`, `.stl`. What `etsplat export` turned, scaled and placed is in the
            frame of its capture again, where the file says how (OFF does not).
        tell: called with a sentence for each thing of the file that is otherwise in the soup.

    Raises:
        InputError: the file is missing, damaged or of another kind.

    Example:
        >>> corners = torch.rand(12, 3, 3)
        >>> soup = etsplat.TriangleSoup.from_triangles(corners, 0.5, opacity=0.9, sigma=0.5, sh_degree=0)
        >>> written = etsplat.export(soup, "scene.ply", etsplat.ExportConfig(colors="keep"))
        >>> etsplat.load_soup(written.path).vertices.equal(corners)
        True
    """
    path = given_path("path", path)
    if path.is_dir():
        raise InputError(f"soup {path}: is a folder; of a run take soup.safetensors in it")
    if not path.is_file():
        raise InputError(f"soup {path}: no such file; check the path")
    if kind_of(path) not in _KINDS:
        raise InputError(f"soup {path}: unknown kind of file; choose one of {', '.join(_KINDS)}, or a run's folder")
    if kind_of(path) == ".safetensors" and holds_opaque(path):
        mesh = load_opaque(path)
        assert mesh.vertex_colors is not None
        corners, colors = mesh.vertices[mesh.faces], mesh.vertex_colors[mesh.faces]
        soup = SolidSoup.of_corners(corners, colors, SoupAppearance(), {"source": path.name})
    elif kind_of(path) == ".safetensors":
        soup = TriangleSoup.load(path)
    elif kind_of(path) == ".etz":
        soup = open_compact(path)
    else:
        readers = {".pt": lambda path, _: _read_triangle_splatting(path), ".ply": _read_ply}
        soup = readers.get(kind_of(path), _read_mesh)(path, tell)
        soup = replace(soup, **soup.state(), notes={"source": path.name, **soup.notes})
    if not len(soup):
        raise InputError(f"soup {path}: holds no triangle; take another file")
    soup.check_finite(path)
    return soup


def _read_triangle_splatting(path: Path) -> TriangleSoup:
    """The state dict that Triangle Splatting saves; its numbers mean the same as ours. No code in it is run."""
    try:
        state = read_state_dict(path)
    except Exception as error:  # torch's unpickler raises anything, depending on the bytes
        # Its own words would have the reader run whatever code is in the file.
        raise InputError(f"soup {path}: cannot be read as a state dict of tensors alone; save it again") from error
    if not isinstance(state, dict) or not all(isinstance(state.get(key), Tensor) for key in _TS_KEYS):
        raise InputError(f"soup {path}: lacks keys of Triangle Splatting's point_cloud_state_dict.pt")
    try:
        count, parts = len(state[_TS_KEYS[0]]), (state[key].detach().float() for key in _TS_KEYS)
        shapes = ((count, 3, 3), (count,), (count,), (count, 1, 3), (count, -1, 3))
        soup = TriangleSoup(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))
    except (RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"soup {path}: its tensors do not fit together ({error}); save it again") from error
    degree = state.get("active_sh_degree", soup.sh_degree)
    if not isinstance(degree, int) or not 0 <= degree <= MAX_DEGREE:
        raise InputError(f"soup {path}: active_sh_degree is not from 0 to {MAX_DEGREE}; save it again")
    # near_plane: Triangle Splatting drops triangles whose centroid is nearer than 0.2, we those with such a corner.
    appearance = SoupAppearance("single_sided", "sdf", sh_degree=degree, cull_small=True, near_plane=0.2)
    return replace(soup, appearance=appearance)


def _read_ply(path: Path, tell: Callable[[str], None]) -> TriangleSoup:
    header = read_ply_header(path)
    if "packed_position" in header.properties("vertex"):
        raise InputError(f"soup {path}: holds compressed Gaussians, which are not read; save it as plain PLY")
    if {"scale_0", "rot_0", "opacity", "f_dc_0"} <= header.properties("vertex"):
        return _read_gaussians(path)
    if {CORNERS, "opacity", "sigma"} <= header.properties("face"):
        return _read_exported(path, header.comments, tell)
    return _read_mesh(path, tell)


def _read_exported(path: Path, comments: list[str], tell: Callable[[str], None]) -> TriangleSoup:
    record = read_record(path)
    if (transform := transform_of_record(path, record)).moves:
        tell(LED_BACK)
    tables = read_ply_tables(path, ("vertex", "face"))
    vertex, face = tables["vertex"], tables["face"]
    points = transform.invert(columns(path, vertex, *"xyz")).float()
    corners = face[CORNERS].astype(np.int64)
    if corners.size and not 0 <= corners.min() <= corners.max() < len(points):
        raise InputError(f"soup {path}: has corners that name no vertex; export it again")
    if (colors := _corner_colors(path, vertex, corners)) is not None:
        return SolidSoup.of_corners(points[torch.from_numpy(corners)], colors, SoupAppearance(), _notes(path, record))
    opacity, sigma = columns(path, face, "opacity", "sigma").float().double().unbind(dim=1)
    if "f_dc_0" in (face.dtype.names or ()):
        dc, rest = _harmonics(path, face)
    else:
        colors = columns(path, face, *COLORS).float() / 255
        dc, rest = ((colors - 0.5) / SH_CONSTANT)[:, None], torch.zeros(len(face), 0, 3)
    soup = TriangleSoup(
        points[torch.from_numpy(corners)],
        torch.logit(opacity.clamp(1e-6, 1 - 1e-7)).float(),
        (sigma - SOUP_SIGMA_FLOOR).clamp_min(1e-6).log().float(),
        dc,
        rest,
    )
    soup = replace(soup, notes=_notes(path, record))
    if "appearance" in record:
        return replace(soup, appearance=_appearance(path, record["appearance"]))
    words = next((comment.split() for comment in comments if comment.startswith("etsplat ")), [])
    known = len(words) == 3 and words[2] in DISTANCES
    return replace(soup, appearance=_known(path, SoupAppearance(words[1], words[2]))) if known else soup


def _corner_colors(path: Path, vertex: np.ndarray, corners: np.ndarray) -> Float[Tensor, "F 3 3"] | None:
    """What an opaque mesh has; None of a soup, whose triangles have one colour each."""
    if not set(COLORS) <= set(vertex.dtype.names or ()):
        return None
    colors = columns(path, vertex, *COLORS)[torch.from_numpy(corners)].float() / 255
    return colors if bool((colors != colors[:, :1]).any()) else None


def _appearance(path: Path, said: Any) -> SoupAppearance:
    try:
        return _known(path, SoupAppearance.from_json(json.dumps(said)))
    except ValueError as error:
        raise damaged(path, "appearance") from error


def _known(path: Path, appearance: SoupAppearance) -> SoupAppearance:
    """Raises InputError for a kernel that is not there."""
    if appearance.kernel not in KERNELS:
        raise InputError(
            f"soup {path}: is drawn with kernel {appearance.kernel!r}, which is not registered; take soup.safetensors"
        )
    return appearance


def _notes(path: Path, record: Mapping[str, Any]) -> dict[str, str]:
    """Those of the soup that was exported, where the file has them, and what its record says of up and of the world."""
    notes = record.get("notes", {})
    if not isinstance(notes, dict) or not all(isinstance(value, str) for value in notes.values()):
        raise damaged(path, "notes")
    told = {}
    if record.get("georeference") is not None:
        told[GEOREFERENCE_NOTE] = json.dumps(record["georeference"])
    if record.get("up") in ("y", "z") and record.get("place") != "world":
        up = transform_of_record(path, dict(record)).rotation["xyz".index(record["up"])]
        told[UP_NOTE] = " ".join(map(repr, up.tolist()))
    return told | notes


def _read_gaussians(path: Path) -> TriangleSoup:
    """A triangle for each Gaussian, across its two larger axes; its third axis, the thinnest, is lost.

    Flat ones, as 2DGS has them, have no third.
    """
    table = read_ply_tables(path)["vertex"]
    centers = columns(path, table, *"xyz")
    third = ["scale_2"] if "scale_2" in (table.dtype.names or ()) else []
    scales = columns(path, table, "scale_0", "scale_1", *third).exp()
    rotations = _rotations(columns(path, table, "rot_0", "rot_1", "rot_2", "rot_3"))
    logits = columns(path, table, "opacity")[:, 0].float()
    dc, rest = _harmonics(path, table)
    order = scales.argsort(dim=1, descending=True)[:, :2]
    radii = 2 * GAUSSIAN_INRADIUS * scales.gather(1, order)  # to the corners: twice the inradius
    axes = rotations.gather(2, order[:, None].expand(-1, 3, -1)) * radii[:, None]
    angles = torch.arange(3, dtype=torch.float64) * (2 * math.pi / 3)
    circle = torch.stack([angles.cos(), angles.sin()], dim=1)
    vertices = centers[:, None] + torch.einsum("kc,nac->nka", circle, axes)
    raw = torch.full((len(table),), math.log(GAUSSIAN_SIGMA - SOUP_SIGMA_FLOOR))
    return TriangleSoup(vertices.float(), logits, raw, dc, rest)


def _read_mesh(path: Path, tell: Callable[[str], None]) -> SolidSoup:
    mesh, record = load_exported(path)
    for note in mesh.notes:
        tell(note)
    if mesh.texture is not None:
        tell(
            f"its texture is drawn as colours of {len(mesh.faces):,} triangles and their corners, without what is finer"
        )
        colors = _fitted(mesh.texture)
    elif mesh.face_colors is not None:
        colors = mesh.face_colors[:, None].repeat(1, 3, 1)
    elif mesh.vertex_colors is not None:
        colors = mesh.vertex_colors[mesh.faces]
    else:
        colors = torch.full((len(mesh.faces), 3, 3), 0.8)
    return SolidSoup.of_corners(mesh.vertices[mesh.faces], colors, SoupAppearance(), _notes(path, record))


def _fitted(texture: Texture) -> Float[Tensor, "F 3 3"]:
    """Colours of the corners of faces under a texture: by least squares, of points evenly spread over each."""
    faces = torch.arange(len(texture.corner_uvs))
    steps = [(i + 1 / 3, j + 1 / 3) for i in range(_SPREAD) for j in range(_SPREAD - i)]
    weights = torch.tensor([(a, b, _SPREAD - a - b) for a, b in steps]) / _SPREAD
    inverse, colors = torch.linalg.pinv(weights), torch.zeros(len(faces), 3, 3)
    for point, part in zip(weights, inverse.T, strict=True):
        colors += part[:, None] * texture.colors(faces, point.expand(len(faces), 3))[:, None]
    return colors.clamp(0, 1)


def _harmonics(path: Path, table: np.ndarray) -> tuple[Tensor, Tensor]:
    """Coefficients (N, 1, 3), (N, R, 3) from f_dc_* and f_rest_*; these hold all of red, then green, then blue."""
    dc = columns(path, table, *(f"f_dc_{channel}" for channel in range(3))).float()[:, None]
    count = sum(name.startswith("f_rest_") for name in table.dtype.names or ())
    if count not in [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_DEGREE + 1)]:
        raise InputError(f"soup {path}: has {count} properties f_rest_*, as no harmonics have; export it again")
    if not count:
        return dc, dc.new_zeros((len(table), 0, 3))
    rest = columns(path, table, *(f"f_rest_{index}" for index in range(count))).float()
    return dc, rest.reshape(len(table), 3, count // 3).transpose(1, 2).contiguous()


def _rotations(quaternions: Tensor) -> Tensor:
    """(N, 3, 3) of quaternions (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(dim=1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    ]
    return torch.stack(rows, dim=1)
