"""Surfaces as files for other programs: a module for each kind, `ply.py` writes .ply. It is found by being here.

`Writer` says what a module holds. Its first line says what its files are for: the command line's help shows it.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, cast

from etsplat.io.atomic import atomic_write
from etsplat.io.paths import kind_of

if TYPE_CHECKING:  # help, which lists the kinds, must not wait for it
    import numpy as np

Colors: TypeAlias = "np.ndarray | None"
Content = Literal[
    "vertex_colors", "face_colors", "texture", "alpha", "numbers", "objects", "z_up", "normals", "offset", "compressed"
]
"""What a kind of file may have room for, beside vertices and faces: several objects; +z up, where no rule says +y;
an offset in float64; fewer bits."""

Compression = Literal["none", "quantize", "meshopt"]
"""How arrays are stored: in 32 bits; in 8 and 16; or those compressed."""

PictureKind = Literal["png", "webp"]
"""How pictures within a file are stored."""


@dataclass(frozen=True)
class SurfaceTexture:
    """A picture over all triangles.

    Attributes:
        pixels: (H, W, 3) uint8, display values, row by row from the top.
        corner_uvs: (F, 3, 2) where the corners of each face are in it: (0, 0) is its upper left corner, (1, 1) the
            lower right one.
        mipmaps: whether viewers may shrink it; not if parts that lie side by side belong to faces apart.
        relief: how light falls on it, or None for colours that are shown as they are.
        kind: how it is stored within a file; beside one it is a PNG.
    """

    pixels: "np.ndarray"
    corner_uvs: "np.ndarray"
    mipmaps: bool = True
    relief: "SurfaceNormals | None" = None
    kind: PictureKind = "png"


@dataclass(frozen=True)
class SurfaceNormals:
    """Arrays as of `etsplat.io.textures.NormalMap`.

    Attributes:
        pixels: (H, W, 3) uint8, normals in tangent space.
        normals: (F, 3, 3) of the corners.
        tangents: (F, 3, 4) of the corners.
        occlusion: (H, W) uint8, or None.
    """

    pixels: "np.ndarray"
    normals: "np.ndarray"
    tangents: "np.ndarray"
    occlusion: "np.ndarray | None" = None


@dataclass(frozen=True)
class Surface:
    """Triangles, and what may be known of them. Colours are display values (sRGB) in [0, 1], with alpha where C is 4.

    Attributes:
        vertices: (V, 3) float32.
        faces: (F, 3) indices into `vertices`.
        vertex_colors: (V, C), or None.
        face_colors: (F, C), or None.
        numbers: further values (F,) of each face, by name.
        comment: a line of text.
        name: what programs call the object.
        record: how it was made, by name, as JSON has it.
        texture: in the place of colours, or None.
        offset: (3,) float64, what has to be added to all vertices, whose float32 could not hold the sum; or None.
            Kinds of files that hold "offset" do it.
        z_up: whether z is known to be up, so that files that have +y up by their standard turn it.
        sky: what lies behind the scene, as an object of its own whose triangles are to be seen from one side: that from
            which their corners run counterclockwise.
        compress: how its arrays are stored where there is a choice ("compressed").
    """

    vertices: "np.ndarray"
    faces: "np.ndarray"
    vertex_colors: Colors = None
    face_colors: Colors = None
    numbers: "Mapping[str, np.ndarray]" = field(default_factory=dict)
    comment: str | None = None
    name: str = ""
    record: "Mapping[str, Any]" = field(default_factory=dict)
    texture: SurfaceTexture | None = None
    offset: "np.ndarray | None" = None
    z_up: bool = False
    sky: "Surface | None" = None
    compress: Compression = "none"

    @property
    def places(self) -> "np.ndarray":
        """(V, 3) vertices with the offset, float64; without one as they are."""
        return self.vertices if self.offset is None else self.vertices.astype("f8") + self.offset

    @property
    def digits(self) -> str:
        """How coordinates are printed so that they come back as they are."""
        return "%.9g" if self.offset is None else "%.15g"


class Writer(Protocol):
    """A module of this folder: one kind of file, after which it is named.

    Attributes:
        HOLDS: what such files have room for; `write` leaves out the rest.
    """

    HOLDS: frozenset[Content]

    def write(self, path: Path, surface: Surface) -> None:
        """Write the file."""
        ...


def purposes() -> dict[str, str]:
    """What each kind of file is for, by its name, without importing the modules."""
    modules = sorted(module for folder in __path__ for module in Path(folder).glob("[!_]*.py"))
    return {module.stem: module.read_text(encoding="utf-8").splitlines()[0].strip('"') for module in modules}


def suffixes(holding: Content | None = None) -> list[str]:
    """Endings of the files that can be written; of those that have room for something."""
    return [f".{kind}" for kind in purposes() if holding is None or holding in _writer(kind).HOLDS]


def writer_of(path: Path, holding: Content | None = None) -> Writer:
    """What writes the kind of file that a path ends in.

    Raises:
        ValueError: none does, or such files have no room for what they must hold.
    """
    if kind_of(path) not in suffixes(holding):
        raise ValueError(f"path: expected one of the suffixes {', '.join(suffixes(holding))}, got {path.name}")
    return _writer(kind_of(path)[1:])


def save_surface(path: Path, surface: Surface) -> None:
    """Write the kind of file that the path ends in. Atomic.

    Raises:
        ValueError: nothing writes that kind.
        InputError: the file cannot be written.
    """
    writer = writer_of(path)
    with atomic_write(path) as temporary:
        writer.write(temporary, surface)


def _writer(kind: str) -> Writer:
    return cast(Writer, importlib.import_module(f"{__name__}.{kind}"))
