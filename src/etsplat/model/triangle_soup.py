"""The learnable triangle soup of novel-view synthesis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError
from torch import Tensor

from etsplat.core.backgrounds import for_each_view
from etsplat.core.cameras import Cameras, check_cameras
from etsplat.core.errors import InputError
from etsplat.core.harmonics import MAX_DEGREE, SH_CONSTANT
from etsplat.core.rasterization import SOUP_SIGMA_FLOOR, Rasterization, joined
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import (
    check_above,
    check_count,
    check_floating,
    check_kind,
    check_open_unit,
    check_shape,
    first_not_finite,
)
from etsplat.io.kernel_files import adopt_kernel, kernel_tensors
from etsplat.io.paths import given_path, kind_of
from etsplat.io.tensors import read_tensors, save_tensors
from etsplat.model.model import Backgrounds, Depth, Model
from etsplat.model.soup_appearance import OPAQUE_FROM, SMALLEST_INRADIUS, SoupAppearance
from etsplat.model.start_colors import start_colors
from etsplat.ops.rasterize import rasterize
from etsplat.ops.rasterize_opaque import render_opaque
from etsplat.ops.soup_activation import soup_activation
from etsplat.ops.soup_colors import soup_colors
from etsplat.ops.spherical_harmonics import spherical_harmonics

FORMAT = "etsplat soup 1"

FOCAL_NOTE = "focal"
"""Note of a trained soup: the mean focal length of the photos, in pixels of the size at which they were seen."""

GEOREFERENCE_NOTE = "georeference"
"""Note of a trained soup: where its units lie in the world, as `etsplat.io.georeference.Georeference` writes it."""

UP_NOTE = "up"
"""Note of a soup from a file that was turned: where up is in the frame of its capture, three numbers."""


class Drawn(NamedTuple):
    """What pictures of N triangles are made of.

    Attributes:
        vertices: (N, 3, 3).
        opacities: (N,).
        sigma: (N,).
        colors: (B, N, 3), as B cameras see them.
    """

    vertices: Any
    opacities: Any
    sigma: Any
    colors: Any


_NEAR_ONE = 1 - 2.0**-24
"""The largest float below 1: what the floor brings to 1 has no finite logit."""


@dataclass(eq=False)
class TriangleSoup(Model):
    """N separate triangles, each with its own opacity, softness and view-dependent colour.

    Opacities pass through a sigmoid and sigma through 0.01 + exp, so that every real parameter is a valid one. Colours
    are spherical harmonics of K = (degree + 1)^2 coefficients in the convention of `ops.spherical_harmonics`; their
    constant band is a parameter of its own because it is learned at another rate.

    Attributes:
        vertices: (N, 3, 3) corner positions, learnable.
        opacity_logits: (N,) learnable.
        sigma_raw: (N,) learnable; sigma = 0.01 + exp(sigma_raw).
        sh_dc: (N, 1, 3) coefficients of the constant band, learnable.
        sh_rest: (N, K - 1, 3) those of the other bands, learnable.
        appearance: how it is drawn; its near plane is in the same units as the corners.
        notes: whatever else its maker wrote down, as text (iteration, source).
        BESIDE: parameters that are not of its triangles.

    Example:
        >>> points = etsplat.StartPoints(torch.rand(50, 3), torch.full((50, 3), 0.5))
        >>> soup = etsplat.start_soup(points, torch.Generator(), scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
        >>> soup.render(etsplat.orbit_cameras(16, 12)[0]).color.shape
        torch.Size([1, 12, 16, 3])
    """

    __repr__ = short_repr

    RATES: ClassVar[Mapping[str, float]] = {
        "vertices": 1.5e-3,
        "opacity_logits": 0.05,
        "sigma_raw": 0.005,
        "sh_dc": 0.01,
        "sh_rest": 0.0005,
    }
    OPAQUE: ClassVar[str] = "opaque"
    COLORED: ClassVar[tuple[str, str, str] | None] = ("vertices", "sh_dc", "sh_rest")
    BESIDE: ClassVar[tuple[str, ...]] = ()

    vertices: Float[Tensor, "N 3 3"]
    opacity_logits: Float[Tensor, " N"]
    sigma_raw: Float[Tensor, " N"]
    sh_dc: Float[Tensor, "N 1 3"]
    sh_rest: Float[Tensor, "N R 3"]
    appearance: SoupAppearance = field(default_factory=SoupAppearance)
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        N = len(self.vertices)
        for name, shape in (
            ("vertices", (N, 3, 3)),
            ("opacity_logits", (N,)),
            ("sigma_raw", (N,)),
            ("sh_dc", (N, 1, 3)),
            ("sh_rest", (N, self.sh_rest.shape[1] if self.sh_rest.ndim == 3 else -1, 3)),
        ):
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name} must have shape {shape}, got {tuple(getattr(self, name).shape)}")
        if self.sh_rest.shape[1] not in [(degree + 1) ** 2 - 1 for degree in range(MAX_DEGREE + 1)]:
            raise ValueError(f"sh_rest must hold 0, 3, 8 or 15 bases, got {self.sh_rest.shape[1]}")

    @classmethod
    def from_triangles(
        cls,
        vertices: Float[Tensor, "N 3 3"],
        colors: Float[Tensor, "N 3"] | Sequence[float] | float,
        *,
        opacity: float,
        sigma: float,
        sh_degree: int,
    ) -> "TriangleSoup":
        """A soup to start from: the same colour from every side.

        Args:
            vertices: (N, 3, 3) corner positions.
            colors: (N, 3), or of all three numbers, or one grey value, in [0, 1].
            opacity: of every triangle, in (0, 1).
            sigma: softness of every triangle, above 0.01.
            sh_degree: of the colours, 0 to 3.

        Raises:
            ValueError: wrong shapes, or numbers out of their range.
        """
        check_shape("vertices", vertices, ("N", 3, 3))
        check_floating("vertices", vertices)
        start = start_colors(colors, "N", N := len(vertices), vertices)
        check_open_unit("opacity", opacity)
        check_above("sigma", sigma, SOUP_SIGMA_FLOOR)
        sh_degree = check_count("sh_degree", sh_degree, least=0, most=MAX_DEGREE)
        logit = torch.logit(torch.tensor(float(opacity), dtype=torch.float64)).to(vertices)
        raw = torch.tensor(float(sigma) - SOUP_SIGMA_FLOOR, dtype=torch.float64).log().to(vertices)
        return cls(
            vertices=vertices.detach().clone(),
            opacity_logits=logit.repeat(N),
            sigma_raw=raw.repeat(N),
            sh_dc=((start - 0.5) / SH_CONSTANT)[:, None, :],
            sh_rest=vertices.new_zeros((N, (sh_degree + 1) ** 2 - 1, 3)),
        ).learnable()

    @classmethod
    def load(cls, path: Path | str) -> "TriangleSoup":
        """Read a soup that `save` wrote. Its parameters do not require gradients. A kernel from Python is registered.

        Raises:
            InputError: the file is missing, cut short, of another kind, or holds numbers that are not finite.
        """
        path = given_path("path", path)
        if not path.is_file():
            raise InputError(f"soup {path}: no such file; check the path")
        if kind_of(path) != ".safetensors":
            raise InputError(f"soup {path}: is no .safetensors; etsplat.load_soup reads other kinds of files")
        try:
            tensors, metadata = read_tensors(path)
            if metadata.get("format") != FORMAT:
                raise ValueError("not a soup of this version of etsplat")
            notes = {key.removeprefix("note."): value for key, value in metadata.items() if key.startswith("note.")}
            parameters = {name: tensors[name].float() for name in cls.RATES}
            soup = cls(**parameters, appearance=SoupAppearance.from_json(metadata["appearance"]), notes=notes)
        except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
            detail = (str(error) or type(error).__name__).splitlines()[0]
            raise InputError(f"soup {path}: cannot be read ({detail}); was it written by `etsplat train`?") from error
        adopt_kernel(path, soup.appearance.kernel, tensors)
        soup.check_finite(path)
        return soup

    def save(self, path: Path | str) -> None:
        """Write parameters, appearance and notes, and the table of a kernel from Python, atomically.

        Raises:
            ValueError: `path` does not end in .safetensors; a parameter holds NaN or infinity.
            InputError: the file cannot be written.
        """
        path = given_path("path", path)
        if (bad := first_not_finite(self.parameters())) is not None:
            raise ValueError(
                f"{bad} holds NaN or infinity: a soup that is read must be finite; torch.save keeps state()"
            )
        if kind_of(path) != ".safetensors":
            raise ValueError(
                f"path: expected the suffix .safetensors, got {path.name}; etsplat.export writes files of other kinds"
            )
        notes = {f"note.{key}": value for key, value in self.notes.items()}
        tensors = {**self.state(), **kernel_tensors(self.appearance.kernel)}
        save_tensors(path, tensors, {**notes, "format": FORMAT, "appearance": self.appearance.to_json()})

    def check_finite(self, path: Path) -> None:
        """Raises InputError, naming the file, for NaN or infinity among the parameters."""
        if (bad := first_not_finite(self.parameters())) is not None:
            raise InputError(f"soup {path}: {bad} holds NaN or infinity; take another file")

    def __len__(self) -> int:
        return len(self.vertices)

    @torch.no_grad()
    def joined(self, other: "TriangleSoup") -> "TriangleSoup":
        """The triangles of both, in new learnable tensors.

        Raises:
            ValueError: the other is no soup; colours of another degree.
        """
        check_kind("other", other, TriangleSoup)
        theirs = other.parameters()
        if other.sh_rest.shape[1:] != self.sh_rest.shape[1:]:
            degrees = f"{1 + other.sh_rest.shape[1]} harmonics instead of {1 + self.sh_rest.shape[1]}"
            raise ValueError(f"other must have colours of the same degree, got {degrees}")
        both = {name: torch.cat([mine, theirs[name]]) for name, mine in self.parameters().items()}
        return replace(self, **both).learnable()

    @torch.no_grad()
    def kept(self, rows: Bool[Tensor, " N"]) -> "TriangleSoup":
        """Some of the triangles, detached."""
        own = {name: values for name, values in self.parameters().items() if name not in self.BESIDE}
        return replace(self, **{name: values.detach()[rows] for name, values in own.items()})

    @property
    def count(self) -> int:
        """Number of triangles."""
        return len(self)

    def describe(self) -> dict[str, float]:
        """For the log: number of triangles, and deciles of softness and opacity as they are drawn."""
        state: dict[str, float] = {"triangles": self.count}
        for name, tensor in (("sigma", self.drawn_sigma), ("opacity", self.drawn_opacities)):
            ordered = tensor.detach().sort().values
            for suffix, fraction in (("_10", 0.1), ("", 0.5), ("_90", 0.9)):
                state[name + suffix] = float(ordered[int(fraction * (len(ordered) - 1))])
        return state

    def render(
        self,
        cameras: Cameras,
        *,
        backgrounds: Backgrounds | None = None,
        outputs: tuple[str, ...] = ("color",),
        depth_of: Depth = "plane",
    ) -> Rasterization:
        """Splat the triangles into the images of B cameras; differentiable with respect to the parameters.

        Args:
            cameras: B cameras.
            backgrounds: (3,) behind all views, or (B, 3); None is black.
            outputs: as in `etsplat.rasterize`.
            depth_of: as there.

        Raises:
            ValueError: the cameras are none, or of another dtype or device than the parameters.
        """
        check_cameras(cameras, "soup.vertices", self.vertices)
        look = self.appearance
        culls = look.cull_small or look.cull_large < float("inf")
        if culls and len(cameras) > 1:  # which triangles are left out differs from view to view
            if (behind := for_each_view(backgrounds, len(cameras))) is not None:
                check_shape("backgrounds", behind, (3,), (len(cameras), 3))
            views = [(cameras[i], None if behind is None else behind[i : i + 1]) for i in range(len(cameras))]
            return joined([self.render(v, backgrounds=b, outputs=outputs, depth_of=depth_of) for v, b in views])
        drawn = self.drawn(cameras, culls=culls)
        return rasterize(
            drawn.vertices,
            opacities=drawn.opacities,
            sigma=drawn.sigma,
            face_colors=drawn.colors,
            cameras=cameras,
            kernel=look.kernel,
            distance=look.distance,
            backgrounds=backgrounds,
            outputs=outputs,
            depth_of=depth_of,
            near_plane=look.near_plane,
            freeze_inradius=look.freeze_inradius,
            validate=False,
        )

    def _rows(self, state: Mapping[str, Tensor]) -> Mapping[str, int]:
        count = len(state.get("vertices", self.vertices))
        return {name: count for name in self.parameters() if name not in self.BESIDE}

    def drawn(self, cameras: Cameras, *, culls: bool) -> Drawn:
        """What is rasterized, differentiable.

        Args:
            cameras: B cameras; one where `culls`.
            culls: triangles that the appearance leaves out are transparent.
        """
        look = self.appearance
        colors = soup_colors(self.vertices, self.sh_dc, self.sh_rest, cameras.centers, self.drawn_degree)
        opacities, sigma = soup_activation(
            self.vertices,
            self.opacity_logits,
            self.sigma_raw,
            look.numbers if look.on_device_numbers is None else look.on_device_numbers,
            cameras if culls else None,
            smallest=SMALLEST_INRADIUS if look.cull_small else 0.0,
            largest=look.cull_large * max(cameras.width, cameras.height),
        )
        return Drawn(self.vertices, opacities, sigma, colors)

    @torch.no_grad()
    def render_opaque(self, cameras: Cameras, *, supersampling: int = 4) -> Float[Tensor, "B H W 4"]:
        """What a mesh viewer shows: sharp opaque triangles with a z-buffer, colours as each camera sees them.

        Args:
            cameras: B cameras.
            supersampling: samples along each axis of a pixel.

        Returns:
            (B, H, W, 4) premultiplied RGBA. Triangles with an opacity below one half are left out.

        Raises:
            ValueError: as of `render`.
        """
        check_cameras(cameras, "soup.vertices", self.vertices)
        kept = self.seen_opaque
        vertices, dc, rest = (tensor.detach()[kept] for tensor in (self.vertices, self.sh_dc, self.sh_rest))
        images = [
            render_opaque(
                vertices,
                cameras=camera,
                face_colors=soup_colors(vertices, dc, rest, camera.centers, self.drawn_degree)[0],
                supersampling=supersampling,
                near_plane=self.appearance.near_plane,
            ).rgba
            for camera in (cameras[index] for index in range(len(cameras)))
        ]
        return torch.cat(images)

    def surface(self) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
        """Corners and faces of the triangles that are drawn opaque, detached, on the CPU."""
        vertices = self.vertices.detach()[self.seen_opaque].cpu().reshape(-1, 3)
        return vertices, torch.arange(len(vertices)).reshape(-1, 3)

    def finished(self) -> "TriangleSoup":
        """The same with all that its appearance squeezes written into its parameters, detached."""
        look, parameters = self.appearance, self.state()
        if look.opacity_floor > 0:
            drawn = self.drawn_opacities.detach().double().clamp_max(_NEAR_ONE)
            parameters["opacity_logits"] = torch.logit(drawn).float()
        if look.sigma_ceiling < float("inf"):
            highest = torch.tensor(look.sigma_ceiling - SOUP_SIGMA_FLOOR).log()
            parameters["sigma_raw"] = parameters["sigma_raw"].clamp_max(float(highest))
        return replace(self, **parameters, appearance=look.structure)

    @property
    def drawn_opacities(self) -> Float[Tensor, " N"]:
        """(N,) as they are drawn, above the appearance's floor: floor + (1 - floor) o."""
        floor = self.appearance.opacity_floor
        return self.opacities if floor == 0.0 else floor + (1.0 - floor) * self.opacities

    @property
    def drawn_sigma(self) -> Float[Tensor, " N"]:
        """(N,) as it is drawn, below the appearance's ceiling."""
        ceiling = self.appearance.sigma_ceiling
        return self.sigma if ceiling == float("inf") else self.sigma.clamp_max(ceiling)

    @property
    def drawn_degree(self) -> int:
        """Of the bands of the colours that are drawn."""
        asked = self.appearance.sh_degree
        return self.sh_degree if asked is None else min(asked, self.sh_degree)

    @property
    def seen_opaque(self) -> Bool[Tensor, " N"]:
        """(N,) which triangles are drawn where the soup is drawn opaque: those half opaque or more."""
        return self.drawn_opacities.detach() >= OPAQUE_FROM

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """(N,) in (0, 1), differentiable."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def sigma(self) -> Float[Tensor, " N"]:
        """(N,) softness, above 0.01, differentiable."""
        return SOUP_SIGMA_FLOOR + torch.exp(self.sigma_raw)

    @property
    def sh_degree(self) -> int:
        """Degree of the colours, 0 to 3."""
        return round((self.sh_rest.shape[1] + 1) ** 0.5) - 1

    @torch.no_grad()
    def display_colors(
        self, direction: Float[Tensor, "3"] | Float[Tensor, "N 3"] | None = None
    ) -> Float[Tensor, "N 3"]:
        """Colours in [0, 1], detached.

        Args:
            direction: from the camera to the triangles, one for all or one each, of any length; None for the part of
                the colour that is the same from every side.
        """
        if direction is None:
            return (0.5 + SH_CONSTANT * self.sh_dc[:, 0]).clamp(0.0, 1.0)
        directions = direction.to(self.sh_dc).expand(len(self), 3)
        coefficients = torch.cat([self.sh_dc, self.sh_rest], dim=1)
        return spherical_harmonics(coefficients, directions, self.sh_degree).clamp(0.0, 1.0)
