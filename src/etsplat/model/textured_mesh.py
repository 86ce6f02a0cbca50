"""An opaque mesh whose colours are a texture."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.cameras import Cameras, check_cameras
from etsplat.core.errors import InputError
from etsplat.core.rasterization import Rasterization, names_of
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import check_like, check_shape
from etsplat.geometry.topology import MeshTopology
from etsplat.io.georeference import Georeference
from etsplat.io.images import to_8_bit
from etsplat.io.mesh_files import load_mesh, save_mesh, weld_vertices
from etsplat.io.opaque_files import TexturedFile, load_textured, save_textured
from etsplat.io.paths import given_path, kind_of
from etsplat.io.textures import NormalMap, Texture
from etsplat.io.writers import Compression, PictureKind
from etsplat.model.model import Appearance, Backgrounds, Depth, Model
from etsplat.ops.antialias import rasterize_antialiased
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.ops.texture import texture_at_pixels

_STRIP_SAMPLES = 4_000_000
_EXACT = ".safetensors"
_ROUNDING = 1e-6  # of coordinates at the border, counted from the other side


@dataclass(frozen=True)
class TextureAppearance(Appearance):
    """How a texture becomes pictures.

    Attributes:
        max_level: the coarsest level that is shown, as in `etsplat.sample_texture`: 0 for textures whose parts belong
            to faces apart.

    Example:
        >>> vertices, faces = etsplat.icosphere(1)
        >>> apart = torch.rand(len(faces), 3, 2)
        >>> mesh = etsplat.TexturedMesh.from_mesh(vertices, faces, torch.ones(8, 8, 3), apart, max_level=0)
        >>> mesh.appearance
        TextureAppearance(max_level=0)
    """

    max_level: int | None = None


@dataclass(eq=False)
class TexturedMesh(Model):
    """A mesh of opaque triangles under one texture.

    Texels are optimised as they are and clamped to [0, 1] where they leave as a mesh. Where faces lie in the texture is
    no parameter.

    Attributes:
        vertices: (V, 3) positions, welded; learnable.
        texture: (H, W, 3) display values, row by row from the top; learnable.
        face_uvs: (F, 3, 2) texture coordinates of each face's corners, (0, 0) in the upper left corner of the texture.
        topology: connectivity of the faces.
        appearance: how it is drawn.

    Example:
        A grey sphere, where pixels pull at the texels that they show:

        >>> vertices, faces = etsplat.icosphere(1)
        >>> uvs = torch.rand(len(faces), 3, 2, generator=torch.Generator().manual_seed(0))
        >>> mesh = etsplat.TexturedMesh.from_mesh(vertices, faces, torch.full((16, 16, 3), 0.5), uvs)
        >>> mesh.render(etsplat.orbit_cameras(24, 24)[0]).color.mean().backward()
        >>> mesh.texture.grad.shape, bool(mesh.texture.grad.any())
        (torch.Size([16, 16, 3]), True)
    """

    __repr__ = short_repr

    RATES: ClassVar[Mapping[str, float]] = {"vertices": 2e-3, "texture": 1e-2}
    OPAQUE: ClassVar[str] = "mesh"

    vertices: Float[Tensor, "V 3"]
    texture: Float[Tensor, "H W 3"]
    face_uvs: Float[Tensor, "F 3 2"]
    topology: MeshTopology
    appearance: TextureAppearance = field(default_factory=TextureAppearance)

    @classmethod
    def from_mesh(
        cls,
        vertices: Float[Tensor, "V 3"],
        faces: Int[Tensor, "F 3"],
        texture: Float[Tensor, "H W 3"],
        face_uvs: Float[Tensor, "F 3 2"],
        *,
        max_level: int | None = None,
    ) -> "TexturedMesh":
        """A mesh to start from; see the attributes.

        Raises:
            ValueError: wrong shape, dtype or device; the message names the argument.
        """
        check_shape("vertices", vertices, ("V", 3))
        check_shape("faces", faces, ("F", 3))
        check_shape("texture", texture, ("H", "W", 3))
        if isinstance(face_uvs, Tensor) and face_uvs.shape == (len(vertices), 2):
            raise ValueError("face_uvs must be of the corners of faces, got those of vertices: pass uvs[faces]")
        check_shape("face_uvs", face_uvs, (len(faces), 3, 2))
        check_like("texture", texture, "vertices", vertices)
        check_like("face_uvs", face_uvs, "vertices", vertices)
        start, topology = vertices.detach().clone(), MeshTopology.from_faces(faces, len(vertices))
        look = TextureAppearance(max_level)
        return cls(start, texture.detach().clone(), face_uvs.detach().clone(), topology, look).learnable()

    @classmethod
    def load(cls, path: Path | str) -> "TexturedMesh":
        """What `save` wrote, or another program: a mesh with one picture (OBJ with MTL, glTF, PLY); it is welded.

        Raises:
            InputError: the file is missing, damaged, without a texture, or has one of several pictures, or one that
                repeats.
        """
        path = given_path("path", path)
        if kind_of(path) == _EXACT:
            mesh = load_textured(path)
            return cls.from_mesh(*mesh[:4], max_level=mesh.max_level)
        mesh = weld_vertices(load_mesh(path))
        picture = None if mesh.texture is None else mesh.texture.picture()
        if mesh.texture is None or picture is None:
            raise InputError(f"mesh {path}: needs a texture of one picture; bake what it has into one")
        uvs = torch.stack([mesh.texture.corner_uvs[..., 0], 1 - mesh.texture.corner_uvs[..., 1]], dim=-1)
        if float(uvs.min()) < -_ROUNDING or float(uvs.max()) > 1 + _ROUNDING:
            raise InputError(f"mesh {path}: texture coordinates beyond [0, 1], where it repeats; bake it without")
        return cls.from_mesh(mesh.vertices, mesh.faces, picture.float() / 255, uvs)

    def save(
        self,
        path: Path | str,
        normal_map: NormalMap | None = None,
        *,
        world: Georeference | None = None,
        compress: Compression = "none",
        pictures: PictureKind = "png",
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Write a file, atomically: .safetensors exactly; .glb, or .obj and .ply with a .png beside them, of 8 bits.

        Args:
            path: of the file.
            normal_map: for .glb alone, whose material is lit then.
            world: where it lies; as those after it of `etsplat.io.mesh_files.save_mesh`, for other files than
                .safetensors.
            compress: for .glb alone.
            pictures: so.
            record: how it was made.
        """
        vertices, faces = self.surface()
        texture, uvs = self.texture.detach().cpu(), self.face_uvs.cpu()
        if kind_of(path) == _EXACT:
            file = TexturedFile(vertices, faces.long(), texture, uvs, self.appearance.max_level)
            save_textured(Path(path), file)
            return
        from_below = torch.stack([uvs[..., 0], 1 - uvs[..., 1]], dim=-1)
        picture = Texture.of([to_8_bit(texture)], torch.zeros(len(faces), dtype=torch.int64), from_below)
        mipmaps = self.appearance.max_level != 0
        save_mesh(
            path,
            vertices,
            faces.long(),
            texture=picture,
            normal_map=normal_map,
            mipmaps=mipmaps,
            world=world,
            compress=compress,
            pictures=pictures,
            record=record,
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "TexturedMesh":
        """The same mesh on another device or in another precision, its parameters leaf tensors as they are here."""
        moved = super().to(device, dtype)
        return replace(moved, topology=self.topology.to(device), face_uvs=self.face_uvs.to(device=device, dtype=dtype))

    def render(
        self,
        cameras: Cameras,
        *,
        backgrounds: Backgrounds | None = None,
        outputs: tuple[str, ...] = ("color",),
        depth_of: Depth = "plane",
    ) -> Rasterization:
        """A differentiable picture for each camera, not clamped: blended silhouettes can leave [0, 1] by a little.

        Args:
            cameras: B cameras.
            backgrounds: (3,) behind all views, or (B, 3); None is black.
            outputs: colour alone.
            depth_of: has no effect.

        Raises:
            ValueError: the cameras are none, or of another dtype or device than the parameters; other outputs.
        """
        check_cameras(cameras, "mesh.vertices", self.vertices)
        if set(names_of(outputs)) - {"color", "alpha"}:
            raise ValueError(f"outputs of opaque triangles must be colour alone, got {outputs}")
        return rasterize_antialiased(
            self.vertices,
            connectivity=self.topology.connectivity,
            texture=self.texture,
            face_uvs=self.face_uvs,
            max_level=self.appearance.max_level,
            cameras=cameras,
            backgrounds=backgrounds,
            validate=False,  # the loop checks the loss at every step, and the parameters before each checkpoint
        )

    @torch.no_grad()
    def render_opaque(self, cameras: Cameras, *, supersampling: int = 4) -> Float[Tensor, "B H W 4"]:
        """What a mesh viewer shows: the mean of samples in display colours, premultiplied RGBA, strip by strip."""
        texture, s = self.texture.detach().clamp(0, 1), supersampling
        rows = max(1, _STRIP_SAMPLES // (s * s * cameras.width))
        images = texture.new_empty(len(cameras), cameras.height, cameras.width, 4)
        for b in range(len(cameras)):
            for top in range(0, cameras.height, rows):
                count = min(rows, cameras.height - top)
                K = cameras.Ks[b : b + 1] * cameras.Ks.new_tensor([s, s, 1])[:, None]
                K[:, 1, 2] -= s * top
                strip = Cameras(cameras.viewmats[b : b + 1], K, s * cameras.width, s * count)
                seen = rasterize_opaque(self.vertices, cameras=strip, faces=self.faces)
                look = self.face_uvs, self.appearance.max_level, strip.viewmats, strip.Ks
                color = texture_at_pixels(self.vertices, texture, *look, self.faces.int(), seen)
                samples = torch.cat([color * seen.alpha, seen.alpha], dim=-1)
                images[b, top : top + count] = samples.view(count, s, cameras.width, s, 4).mean(dim=(1, 3))
        return images

    def surface(self) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
        """Vertices and faces, detached, on the CPU."""
        return self.vertices.detach().cpu(), self.faces.cpu()

    def describe(self) -> dict[str, float]:
        """For the log: numbers of faces and texels."""
        return {"faces": self.count, "texels": self.texture.shape[0] * self.texture.shape[1]}

    def state(self) -> dict[str, Tensor]:
        """Parameters, faces and where these lie in the texture, detached, by name."""
        return {**super().state(), "faces": self.faces, "face_uvs": self.face_uvs}

    def _rows(self, state: Mapping[str, Tensor]) -> Mapping[str, int]:
        fixed = {} if "faces" in state else {"vertices": len(self.vertices)}
        return {"face_uvs": len(state.get("faces", self.faces)), **fixed}

    def _take(self, state: Mapping[str, Tensor]) -> None:
        topology = self.topology.changed(state.get("faces"), state.get("vertices"))
        super()._take(state)
        self.topology = topology
        if "face_uvs" in state:
            self.face_uvs = state["face_uvs"].to(self.vertices.device)

    @property
    def count(self) -> int:
        """Number of faces."""
        return len(self.faces)

    @property
    def faces(self) -> Int[Tensor, "F 3"]:
        """(F, 3) vertex indices."""
        return self.topology.faces
