"""Settings of the export of soups. Imports no torch: the command line reads them for its help."""

from dataclasses import dataclass
from typing import Annotated, Literal

from etsplat.core.spelling import option
from etsplat.tasks.settings import Only, Range, Settings

Bake = Literal["mean", "constant", "keep"]

SMALLEST = 64
TEXELS = Range(SMALLEST, 8192)
"""Along each side of a texture."""

LIGHT_FACES = 10_000
"""Of a textured mesh, unless told otherwise."""

_TEXTURED = Only(lambda: f"with {option('texture')}", lambda config: config.texture is not None)

_WITH_NORMALS = Only(lambda: f"with {option('normals')}", lambda config: config.normals)


@dataclass(frozen=True)
class ExportConfig(Settings):
    """How a soup, or the mesh of a reconstruction, leaves for other programs.

    Example:
        >>> etsplat.ExportConfig(clean=True, up="z").colors
        'mean'
    """

    texture: Annotated[int | None, TEXELS] = None
    """Of a run of `etsplat reconstruct`: a light mesh under a texture with so many texels along each side.
    It is fitted to the run's photos, and has --faces faces, or 10,000. Needs pip install 'etsplat[texture]'."""
    faces: Annotated[int | None, Range(4, 10_000_000)] = None
    """Of a run of `etsplat reconstruct`: at most so many faces; without --texture in the colours they have.
    Needs pip install 'etsplat[texture]'."""
    normals: Annotated[bool, _TEXTURED] = False
    """With --texture, in GLB: a material that programs light, with the full mesh's relief as a normal map.
    The light of the photos stays in the colours; without it they are shown as they are."""
    lods: Annotated[int, Range(0, 7), _TEXTURED] = 0
    """With --texture: so many coarser levels beside it, in files of their own, NAME_lod1 and on.
    Each has a quarter of the faces of the one before, and half its texels along each side, for twice the distance."""
    occlusion: Annotated[bool, _WITH_NORMALS] = False
    """With --normals: ambient occlusion of the full mesh beside them, for programs that light it from all around."""
    compress: Literal["none", "quantize", "meshopt"] = "none"
    """Of GLB: how what vertices have is stored.
    none: in 32 bits; quantize: positions in 16 bits of the longest side, normals in 8 (KHR_mesh_quantization);
    meshopt: those compressed (EXT_meshopt_compression); needs pip install 'etsplat[compress]'."""
    pictures: Annotated[Literal["png", "webp"], _TEXTURED] = "png"
    """With --texture, in GLB: how its pictures are stored.
    webp: a third of the size, or less, for programs that know EXT_texture_webp; others refuse the file."""
    colors: Bake = "mean"
    """What becomes of colours that depend on the direction.
    mean: one per triangle, of what the training views see;
    constant: one per triangle, the constant part of its harmonics;
    keep: that, and the harmonics beside it (PLY only): the file comes back with the same colours from every side."""
    min_opacity: Annotated[float | None, Range(0, 1)] = None
    """Leave out triangles less opaque than this.
    By default 0.5, as `etsplat render --opaque` does, but 0 with --alpha and in safetensors, etz and html."""
    alpha: bool = False
    """Write the triangles of the soup, faint ones too, with their opacities as alpha (PLY, OFF, GLB).
    Most viewers sort transparent triangles badly."""
    weld: bool = False
    """Let triangles share vertices where positions and colours are equal."""
    triangles: Literal["opaque", "soup"] = "opaque"
    """opaque: the opaque mesh that the run made;
    where it made none, and in files with opacities or colours for each direction, the soup.
    soup: the triangles of the soup in any case."""
    sky: Literal["apart", "joined", "none"] = "apart"
    """What is behind everything, at the distance of the sky.
    apart: an object of its own (GLB, OBJ), in GLB with a material that is seen from inside alone;
    files that hold one object (PLY, OFF) are without it, but those for etsplat (safetensors, --colors keep) have it;
    joined: with the scene in one;
    none, or --no-sky: left out."""
    clean: bool = False
    """Leave out triangles that are out of every training photo's frame, or that none of them shows;
    in files of soft triangles, of 16 photos and more, those that a single one shows;
    then small groups that stand alone.
    What photos show changes next to nothing."""
    up: Literal["y", "z", "keep"] | None = None
    """Turn what is exported so that up, by the photos' place in the world or as cameras were held, is +y or +z;
    or keep the capture's axes. None is y for soups, but keep with --colors keep and for the mesh of a reconstruction.
    GLB has +y up, which programs with another axis turn by themselves: z is for the other kinds of files."""
    scale: Annotated[float, Range(1e-6, 1e6)] = 1.0
    """Multiply all lengths: 0.01 if a unit of the capture is a centimetre, and metres are wanted."""
    place: Literal["keep", "center", "ground", "world"] = "keep"
    """Where the origin is. keep: where the capture has it; center: in the middle of what is exported, but its sky;
    ground: below that, at the height of its lowest parts;
    world: where georeference.json says, in the world's units and axes, whatever --up says: GLB alone has +y up."""

    def contradiction(self) -> str | None:
        """What is wrong with settings that are right one by one."""
        if problem := texture_problem(self.texture):
            return problem
        if self.texture is not None and (self.texture >> self.lods < SMALLEST or self.texture % (1 << self.lods)):
            return f"lods: {self.lods} times half of {self.texture} texels is less than {SMALLEST}, or no whole number"
        return None


def texture_problem(size: int | None, name: str = "texture") -> str | None:
    """What is wrong with a texture of so many texels along each side, which is halved twice; None for none."""
    return f"{name}: is {size}; it must be a multiple of 4" if size is not None and size % 4 else None
