"""The learnable mesh of shape reconstruction."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.cameras import Cameras, check_cameras
from etsplat.core.harmonics import MAX_DEGREE, SH_CONSTANT
from etsplat.core.rasterization import Rasterization, names_of
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import (
    check_above,
    check_count,
    check_finite,
    check_floating,
    check_kind,
    check_open_unit,
    check_shape,
)
from etsplat.data.dataset import Normalization
from etsplat.geometry.measures import area_normals
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile, load_mesh, save_mesh, weld_vertices
from etsplat.model.model import Appearance, Backgrounds, Depth, Model
from etsplat.model.start_colors import start_colors
from etsplat.ops.antialias import rasterize_antialiased
from etsplat.ops.rasterize import rasterize
from etsplat.ops.rasterize_opaque import render_opaque
from etsplat.ops.soup_colors import soup_colors
from etsplat.ops.spherical_harmonics import spherical_harmonics

_SEEN_FROM_FRONT = (2 / 3, 1 / 4, 0.0)
"""Bands 1 to 3, averaged over the directions in front of a face, each with the area that the face shows there: these
parts of their values towards its normal (a clamped cosine in harmonics; Ramamoorthi and Hanrahan 2001)."""

_LIFT = 4.0
"""Added to colours while harmonics are evaluated, which are not below 0."""


@dataclass(frozen=True)
class MeshAppearance(Appearance):
    """How the numbers of a mesh become pictures.

    Attributes:
        kernel: "elastic", "bilateral", "single_sided", or None for opaque triangles with antialiased silhouettes.
        distance: "barycentric" or "sdf".
        backend: whose antialiased rasterizer draws opaque triangles.

    Example:
        >>> vertices, faces = etsplat.icosphere(2)
        >>> look = dict(colors=0.5, opacity=None, sigma=None, appearance=etsplat.MeshAppearance(kernel=None))
        >>> mesh = etsplat.TriangleMesh.from_mesh(vertices, faces, **look)
    """

    kernel: str | None = "elastic"
    distance: str = "barycentric"
    backend: Literal["etsplat", "nvdiffrast"] = "etsplat"

    @property
    def needs_host(self) -> bool:
        """Whether nvdiffrast draws it."""
        return self.kernel is None and self.backend == "nvdiffrast"


@dataclass(eq=False)
class TriangleMesh(Model):
    """A triangle mesh with a colour per face or per vertex; where it is soft, an opacity per face and one softness.

    Colours are optimised as they are (not squashed) and clamped to [0, 1] where they leave as a mesh; opacities pass
    through a sigmoid and sigma through an exponential, so that every real parameter is a valid one.

    Attributes:
        vertices: (V, 3) positions in the unit frame, learnable.
        colors: (F, 3) face colours, or (V, 3) if `vertex_colored`; learnable.
        opacity_logits: (F,) learnable; None for a mesh of opaque triangles.
        log_sigma: () learnable; None for a mesh of opaque triangles.
        harmonics: (F, R, 3) what depends on the direction in colours of soft faces: coefficients of bands 1 and up of
            `etsplat.spherical_harmonics`, R = 3, 8 or 15; learnable. None for colours that are the same from all sides.
        topology: connectivity of the faces.
        vertex_colored: whether colours belong to vertices, and are interpolated over the faces.
        appearance: how it is drawn.

    Example:
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(2), colors=0.7, opacity=0.98, sigma=0.25)
        >>> mesh.count, sorted(mesh.parameters())
        (320, ['colors', 'log_sigma', 'opacity_logits', 'vertices'])
        >>> mesh.render(etsplat.orbit_cameras(32, 32, azimuths=1)[0]).color.shape
        torch.Size([1, 32, 32, 3])
    """

    __repr__ = short_repr

    RATES: ClassVar[Mapping[str, float]] = {
        "vertices": 2e-3,
        "colors": 1e-2,
        "opacity_logits": 1e-3,
        "log_sigma": 1e-4,
        "harmonics": 5e-4,
    }
    OPAQUE: ClassVar[str] = "mesh"

    vertices: Float[Tensor, "V 3"]
    colors: Float[Tensor, "F 3"] | Float[Tensor, "V 3"]
    opacity_logits: Float[Tensor, " F"] | None
    log_sigma: Float[Tensor, ""] | None
    topology: MeshTopology
    vertex_colored: bool = False
    appearance: MeshAppearance = field(default_factory=MeshAppearance)
    harmonics: Float[Tensor, "F R 3"] | None = None

    @classmethod
    def from_mesh(
        cls,
        vertices: Float[Tensor, "V 3"],
        faces: Int[Tensor, "F 3"],
        *,
        colors: Float[Tensor, "F 3"] | Float[Tensor, "V 3"] | Sequence[float] | float,
        opacity: float | None,
        sigma: float | None,
        vertex_colored: bool = False,
        appearance: MeshAppearance | None = None,
        harmonics: int = 0,
    ) -> "TriangleMesh":
        """A mesh to start from.

        Args:
            vertices: (V, 3) positions in the unit frame.
            faces: (F, 3) vertex indices.
            colors: (F, 3), (V, 3) if `vertex_colored`, or of all three numbers, or one grey value, in [0, 1].
            opacity: of every face, in (0, 1); None, as is `sigma`, for opaque triangles.
            sigma: softness, > 0.
            vertex_colored: whether colours belong to vertices.
            appearance: how it is drawn; None for the elastic kernel, or as opaque triangles where it is not soft.
            harmonics: degree, 0 to 3, up to which colours depend on the direction; of soft triangles with face colours.

        Raises:
            ValueError: wrong shapes or dtypes; numbers out of their range; opacity or sigma alone; harmonics of opaque
                triangles or of colours of vertices.
        """
        sizes: dict[str, int] = {}
        check_shape("vertices", vertices, ("V", 3), sizes=sizes)
        check_shape("faces", faces, ("F", 3), sizes=sizes)
        letter = "V" if vertex_colored else "F"
        check_floating("vertices", vertices)
        check_finite("vertices", vertices.detach())
        vertices = vertices.detach().clone()
        soft = _is_soft(opacity, sigma)
        if appearance is not None:
            check_kind("appearance", appearance, MeshAppearance, "MeshAppearance(kernel) makes one")
        harmonics = check_count("harmonics", harmonics, least=0, most=MAX_DEGREE)
        if harmonics and (vertex_colored or not soft):
            raise ValueError("harmonics must be 0 where triangles are opaque or colours belong to vertices")
        rest = vertices.new_zeros(len(faces), (harmonics + 1) ** 2 - 1, 3) if harmonics else None
        logit = torch.logit(_double(opacity)).to(vertices) if soft else None
        return cls(
            vertices=vertices,
            colors=start_colors(colors, letter, sizes[letter], vertices),
            opacity_logits=None if logit is None else logit.repeat(len(faces)),
            log_sigma=_double(sigma).log().to(vertices) if soft else None,
            topology=MeshTopology.from_faces(faces, len(vertices)),
            vertex_colored=vertex_colored,
            appearance=appearance or MeshAppearance("elastic" if soft else None),
            harmonics=rest,
        ).learnable()

    @classmethod
    def load(cls, path: Path | str, *, opacity: float | None = 0.98, sigma: float | None = 0.25) -> "TriangleMesh":
        """A mesh to start from, from a file of any kind that `etsplat.load_mesh` reads, with the colours it has.

        Args:
            path: vertices at equal positions are merged, so that neighbouring faces move together.
            opacity: of every face; None, as is `sigma`, for opaque triangles.
            sigma: softness.

        Raises:
            InputError: the file is missing, damaged or of another kind.
        """
        mesh = weld_vertices(load_mesh(path))
        by_vertex = mesh.face_colors is None and mesh.vertex_colors is not None
        given = mesh.vertex_colors if by_vertex else mesh.face_colors
        colors = 0.5 if given is None else given
        return cls.from_mesh(
            mesh.vertices, mesh.faces, colors=colors, opacity=opacity, sigma=sigma, vertex_colored=by_vertex
        )

    def to_file(self, frame: Normalization | None = None) -> MeshFile:
        """Its surface with display colours, on the CPU; in the input's units where `frame` leads back to these."""
        if frame is not None:
            check_kind("frame", frame, Normalization, "Dataset.normalization is one")
        vertices, faces = self.surface()
        vertices = vertices if frame is None else frame.invert(vertices)
        return MeshFile(vertices, faces, **self.named(self.display_colors.cpu()))

    def save(self, path: Path | str, frame: Normalization | None = None) -> None:
        """Write what a mesh viewer shows, atomically: .ply, .obj or .glb. Opacities and softness are not in it."""
        file = self.to_file(frame)
        save_mesh(path, file.vertices, file.faces, face_colors=file.face_colors, vertex_colors=file.vertex_colors)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "TriangleMesh":
        """The same mesh on another device or in another precision, its parameters leaf tensors as they are here."""
        return replace(super().to(device, dtype), topology=self.topology.to(device))

    def render(
        self,
        cameras: Cameras,
        *,
        backgrounds: Backgrounds | None = None,
        outputs: tuple[str, ...] = ("color",),
        depth_of: Depth = "plane",
    ) -> Rasterization:
        """A differentiable picture for each camera.

        Args:
            cameras: B cameras.
            backgrounds: (3,) behind all views, or (B, 3); None is black.
            outputs: as in `etsplat.rasterize`; of opaque triangles there is colour alone.
            depth_of: as there.

        Returns:
            Images that are not clamped: blended silhouettes can leave [0, 1] by a little.

        Raises:
            ValueError: the cameras are none, or of another dtype or device than the parameters; outputs that opaque
                triangles do not have.
        """
        check_cameras(cameras, "mesh.vertices", self.vertices)
        look = self.appearance
        if look.kernel is None:
            if set(names_of(outputs)) - {"color", "alpha"}:
                raise ValueError(f"outputs of opaque triangles must be colour alone, got {outputs}")
            draw = rasterize_antialiased
            if look.backend == "nvdiffrast":
                from etsplat.ops.antialias_nvdiffrast import rasterize_nvdiffrast as draw
            return draw(
                self.vertices,
                connectivity=self.topology.connectivity,
                **self.named(self._colors_in_front()),
                cameras=cameras,
                backgrounds=backgrounds,
            )
        return rasterize(
            self.vertices,
            opacities=self.opacities,
            sigma=self.sigma,
            **self.named(self._colors_towards(cameras)),
            cameras=cameras,
            faces=self.faces,
            kernel=look.kernel,
            distance=look.distance,
            backgrounds=backgrounds,
            outputs=outputs,
            depth_of=depth_of,
            validate=False,  # the loop checks the loss at every step, and the parameters before each checkpoint
        )

    @torch.no_grad()
    def render_opaque(self, cameras: Cameras, *, supersampling: int = 4) -> Float[Tensor, "B H W 4"]:
        """What a mesh viewer shows: opaque triangles in display colours, premultiplied RGBA.

        Raises:
            ValueError: the cameras are none, or of another dtype or device than the parameters.
        """
        check_cameras(cameras, "mesh.vertices", self.vertices)
        return render_opaque(
            self.vertices.detach(),
            **self.named(self.display_colors),
            cameras=cameras,
            faces=self.faces,
            supersampling=supersampling,
        ).rgba

    def surface(self) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
        """Vertices and faces, detached, on the CPU."""
        return self.vertices.detach().cpu(), self.faces.cpu()

    @property
    def count(self) -> int:
        """Number of faces."""
        return len(self.faces)

    def describe(self) -> dict[str, float]:
        """For the log: number of faces and softness (0 for opaque triangles)."""
        return {"faces": self.count, "sigma": float(self.sigma.detach())}

    def state(self) -> dict[str, Tensor]:
        """Parameters and faces, detached, by name."""
        return {**super().state(), "faces": self.faces}

    def _take(self, state: Mapping[str, Tensor]) -> None:
        topology = self.topology.changed(state.get("faces"), state.get("vertices"))
        super()._take(state)
        self.topology = topology

    def _rows(self, state: Mapping[str, Tensor]) -> Mapping[str, int]:
        vertices = len(state.get("vertices", self.vertices) if "faces" in state else self.vertices)
        faces = len(state.get("faces", self.faces))
        apart = [name for name, parameter in self.parameters().items() if parameter.ndim]
        return {name: vertices if name in self.vertex_parameters else faces for name in apart}

    @property
    def vertex_parameters(self) -> tuple[str, ...]:
        """Names of the parameters with one row per vertex."""
        return ("vertices", "colors") if self.vertex_colored else ("vertices",)

    @property
    def face_parameters(self) -> tuple[str, ...]:
        """Names of the parameters with one row per face."""
        named = {"colors": not self.vertex_colored}
        named |= {name: getattr(self, name) is not None for name in ("opacity_logits", "harmonics")}
        return tuple(name for name, there in named.items() if there)

    @property
    def faces(self) -> Int[Tensor, "F 3"]:
        """(F, 3) vertex indices."""
        return self.topology.faces

    @property
    def opacities(self) -> Float[Tensor, " F"]:
        """(F,) in (0, 1], differentiable."""
        if self.opacity_logits is None:
            return self.vertices.new_ones(len(self.faces))
        return torch.sigmoid(self.opacity_logits)

    @property
    def sigma(self) -> Float[Tensor, ""]:
        """The shared softness, differentiable; 0 for opaque triangles."""
        return self.vertices.new_zeros(()) if self.log_sigma is None else torch.exp(self.log_sigma)

    @property
    def display_colors(self) -> Float[Tensor, "F 3"] | Float[Tensor, "V 3"]:
        """In [0, 1], detached: the colours that an exported mesh carries.

        Where colours depend on the direction, each face's mean over the directions in front of it.
        """
        return self._colors_in_front().detach().clamp(0.0, 1.0)

    @property
    def display_face_colors(self) -> Float[Tensor, "F 3"]:
        """As `display_colors`, of faces: of colours of vertices the mean of a face's three."""
        return self.display_colors[self.faces].mean(dim=1) if self.vertex_colored else self.display_colors

    @property
    def degree(self) -> int:
        """Of the harmonics; 0 where there are none."""
        return 0 if self.harmonics is None else math.isqrt(self.harmonics.shape[1] + 1) - 1

    def _colors_in_front(self) -> Float[Tensor, "F 3"] | Float[Tensor, "V 3"]:
        """`display_colors` before they are clamped; gradients reach what is the same from all sides."""
        return self.colors if self.harmonics is None else self.colors + self._harmonics_in_front(self.harmonics)

    @torch.no_grad()
    def _harmonics_in_front(self, harmonics: Float[Tensor, "F R 3"]) -> Float[Tensor, "F 3"]:
        """What harmonics add to a face's colour, in the mean over the directions in front of it."""
        normals = area_normals(self.vertices, self.faces)
        # Filled on the device: within a captured step nothing may be copied there.
        parts = torch.cat([normals.new_full((2 * band + 1, 1), part) for band, part in enumerate(_SEEN_FROM_FRONT, 1)])
        lifted = normals.new_full((len(normals), 1, 3), (_LIFT - 0.5) / SH_CONSTANT)
        coefficients = torch.cat([lifted, parts[: harmonics.shape[1]] * harmonics], dim=1)
        return spherical_harmonics(coefficients, -normals, self.degree) - _LIFT

    def _constant_band(self) -> Float[Tensor, "F 1 3"]:
        return ((self.colors - 0.5) / SH_CONSTANT)[:, None]

    def _colors_towards(self, cameras: Cameras) -> Tensor:
        """Of vertices, of faces, or of faces in each of B pictures."""
        if self.harmonics is None:
            return self.colors
        corners = self.vertices[self.faces]
        return soup_colors(corners, self._constant_band(), self.harmonics, cameras.centers, self.degree)

    def named(self, colors: Tensor) -> dict[str, Any]:
        """Colours of this mesh as an argument: {"face_colors": colors} or {"vertex_colors": colors}."""
        return {"vertex_colors" if self.vertex_colored else "face_colors": colors}


def _double(value: Any) -> Float[Tensor, ""]:
    return torch.tensor(float(value), dtype=torch.float64)


def _is_soft(opacity: float | None, sigma: float | None) -> bool:
    """Whether triangles are soft; ValueError where that cannot be told, or the numbers are out of range."""
    if (opacity is None) != (sigma is None):
        raise ValueError("opacity and sigma must be given together, or both be None")
    if opacity is None or sigma is None:
        return False
    check_open_unit("opacity", opacity)
    check_above("sigma", sigma)
    return True
