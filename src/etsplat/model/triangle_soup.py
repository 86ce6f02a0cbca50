"""The learnable triangle soup of novel-view synthesis."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.harmonics import MAX_DEGREE
from etsplat.core.rasterization import SOUP_SIGMA_FLOOR
from etsplat.ops.spherical_harmonics import spherical_harmonics

SH_CONSTANT = 0.28209479177387814
"""The constant basis function Y_0: a colour c is the coefficient (c - 1/2) / Y_0."""


@dataclass
class TriangleSoup:
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
    """

    vertices: Float[Tensor, "N 3 3"]
    opacity_logits: Float[Tensor, " N"]
    sigma_raw: Float[Tensor, " N"]
    sh_dc: Float[Tensor, "N 1 3"]
    sh_rest: Float[Tensor, "N R 3"]

    PARAMETERS = ("vertices", "opacity_logits", "sigma_raw", "sh_dc", "sh_rest")

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
        colors: Float[Tensor, "N 3"],
        *,
        opacity: float,
        sigma: float,
        sh_degree: int,
    ) -> "TriangleSoup":
        """A soup to start from: the same colour from every side.

        Args:
            vertices: (N, 3, 3) corner positions.
            colors: (N, 3) in [0, 1].
            opacity: of every triangle, in (0, 1).
            sigma: softness of every triangle, above 0.01.
            sh_degree: of the colours, 0 to 3.
        """
        N = len(vertices)
        logit = torch.logit(torch.tensor(opacity, dtype=torch.float64)).to(vertices)
        raw = torch.tensor(sigma - SOUP_SIGMA_FLOOR, dtype=torch.float64).log().to(vertices)
        soup = cls(
            vertices=vertices.detach().clone(),
            opacity_logits=logit.repeat(N),
            sigma_raw=raw.repeat(N),
            sh_dc=((colors.detach().to(vertices) - 0.5) / SH_CONSTANT)[:, None, :].clone(),
            sh_rest=vertices.new_zeros((N, (sh_degree + 1) ** 2 - 1, 3)),
        )
        for parameter in soup.parameters().values():
            parameter.requires_grad_(True)
        return soup

    def __len__(self) -> int:
        return len(self.vertices)

    @torch.no_grad()
    def joined(self, other: "TriangleSoup") -> "TriangleSoup":
        """The triangles of both, in new learnable tensors."""
        mine, theirs = self.parameters(), other.parameters()
        return TriangleSoup(**{n: torch.cat([mine[n], theirs[n]]).requires_grad_(True) for n in self.PARAMETERS})

    def to(self, device: torch.device) -> "TriangleSoup":
        """The same soup on another device, its parameters leaf tensors as they are here."""
        moved = {name: p.detach().to(device).requires_grad_(p.requires_grad) for name, p in self.parameters().items()}
        return TriangleSoup(**moved)

    def parameters(self) -> dict[str, Tensor]:
        """The learnable tensors by name."""
        return {name: getattr(self, name) for name in self.PARAMETERS}

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
