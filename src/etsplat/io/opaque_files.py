"""The opaque mesh of a scene on disk: exact, in the units and axes of its capture."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from jaxtyping import Float, Int64
from safetensors import SafetensorError, safe_open
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.validation import check_indices, check_shape
from etsplat.io.mesh_files import MeshFile
from etsplat.io.tensors import read_tensors, save_tensors

FORMAT = "etsplat opaque mesh 1"
TEXTURED_FORMAT = "etsplat textured mesh 1"

_MAX_LEVEL = "max_level"


class TexturedFile(NamedTuple):
    """A mesh with a texture; see `etsplat.rasterize_antialiased`."""

    vertices: Float[Tensor, "V 3"]
    faces: Int64[Tensor, "F 3"]
    texture: Float[Tensor, "H W 3"]
    face_uvs: Float[Tensor, "F 3 2"]
    max_level: int | None


def save_opaque(path: Path, mesh: MeshFile) -> None:
    """Write the opaque mesh of a scene, exactly, in the capture's own units. Atomic.

    Raises:
        InputError: the file cannot be written.
    """
    assert mesh.vertex_colors is not None
    tensors = {"vertices": mesh.vertices, "faces": mesh.faces, "vertex_colors": mesh.vertex_colors}
    save_tensors(path, tensors, {"format": FORMAT})


def holds_opaque(path: Path) -> bool:
    """Whether a file of tensors is one of `save_opaque`."""
    try:
        with safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("format") == FORMAT
    except (SafetensorError, OSError, ValueError):
        return False


def load_opaque(path: Path) -> MeshFile:
    """Read what `save_opaque` wrote.

    Raises:
        InputError: the file is missing, cut short, of another kind, or holds what is no mesh.
    """
    with _reading(f"opaque mesh {path}", "was it written by `etsplat train`?"):
        tensors, _ = _read(path, FORMAT, "an opaque mesh")
        vertices, faces, colors = (tensors[name] for name in ("vertices", "faces", "vertex_colors"))
        _check_mesh(vertices, faces)
        check_shape("vertex_colors", colors, (len(vertices), 3))
        _check_finite(vertices, colors)
        return MeshFile(vertices.float(), faces.long(), vertex_colors=colors.float())


def save_textured(path: Path, mesh: TexturedFile) -> None:
    """Write a mesh with a texture, exactly. Atomic.

    Raises:
        InputError: the file cannot be written.
    """
    tensors = {name: value for name, value in mesh._asdict().items() if isinstance(value, Tensor)}
    level = {} if mesh.max_level is None else {_MAX_LEVEL: str(mesh.max_level)}
    save_tensors(path, tensors, {"format": TEXTURED_FORMAT, **level})


def load_textured(path: Path) -> TexturedFile:
    """Read what `save_textured` wrote.

    Raises:
        InputError: the file is missing, cut short, of another kind, or holds what is no such mesh.
    """
    with _reading(f"textured mesh {path}", "was it written by `TexturedMesh.save`?"):
        tensors, metadata = _read(path, TEXTURED_FORMAT, "a textured mesh")
        vertices, faces, texture, uvs = (tensors[name] for name in ("vertices", "faces", "texture", "face_uvs"))
        _check_mesh(vertices, faces)
        check_shape("texture", texture, ("H", "W", 3))
        check_shape("face_uvs", uvs, (len(faces), 3, 2))
        _check_finite(vertices, texture, uvs)
        level = int(metadata[_MAX_LEVEL]) if _MAX_LEVEL in metadata else None
        if texture.numel() == 0 or (level is not None and level < 0):
            raise ValueError("it holds no texel, or a level below 0")
        return TexturedFile(vertices.float(), faces.long(), texture.float(), uvs.float(), level)


@contextmanager
def _reading(what: str, remedy: str) -> Iterator[None]:
    """InputError in the place of whatever reading raises."""
    try:
        yield
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        detail = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{what}: cannot be read ({detail}); {remedy}") from error


def _read(path: Path, kind: str, wanted: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    tensors, metadata = read_tensors(path)
    if metadata.get("format") != kind:
        raise ValueError(f"not {wanted} of this version of etsplat")
    return tensors, metadata


def _check_mesh(vertices: Tensor, faces: Tensor) -> None:
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    check_indices("faces", faces, len(vertices))


def _check_finite(*tensors: Tensor) -> None:
    if not all(bool(tensor.isfinite().all()) for tensor in tensors):
        raise ValueError("it holds NaN or infinity")
