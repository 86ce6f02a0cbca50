"""The learnable mesh of shape reconstruction."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.geometry.topology import MeshTopology


@dataclass
class TriangleMesh:
    """A triangle mesh with a colour per face or per vertex; where it is soft, an opacity per face and one softness.

    Colours are optimised as they are (not squashed) and clamped to [0, 1] where they leave as a mesh; opacities pass
    through a sigmoid and sigma through an exponential, so that every real parameter is a valid one.

    Attributes:
        vertices: (V, 3) positions in the unit frame, learnable.
        colors: (F, 3) face colours, or (V, 3) if `vertex_colored`; learnable.
        opacity_logits: (F,) learnable; None for a mesh of opaque triangles.
        log_sigma: () learnable; None for a mesh of opaque triangles.
        topology: connectivity of the faces.
        vertex_colored: whether colours belong to vertices, and are interpolated over the faces.
    """

    vertices: Float[Tensor, "V 3"]
    colors: Float[Tensor, "F 3"] | Float[Tensor, "V 3"]
    opacity_logits: Float[Tensor, " F"] | None
    log_sigma: Float[Tensor, ""] | None
    topology: MeshTopology
    vertex_colored: bool = False

    @classmethod
    def from_mesh(
        cls,
        vertices: Float[Tensor, "V 3"],
        faces: Int[Tensor, "F 3"],
        *,
        colors: Float[Tensor, "F 3"] | Float[Tensor, "V 3"] | float,
        opacity: float | None,
        sigma: float | None,
        vertex_colored: bool = False,
    ) -> "TriangleMesh":
        """A mesh to start from.

        Args:
            vertices: (V, 3) positions in the unit frame.
            faces: (F, 3) vertex indices.
            colors: (F, 3), (V, 3) if `vertex_colored`, or one grey value for all, in [0, 1].
            opacity: of every face, in (0, 1); None, as is `sigma`, for opaque triangles.
            sigma: softness, > 0.
            vertex_colored: whether colours belong to vertices.
        """
        vertices = vertices.detach().clone()
        count = len(vertices) if vertex_colored else len(faces)
        start = colors if isinstance(colors, Tensor) else torch.full((count, 3), colors)
        soft = opacity is not None and sigma is not None
        logit = torch.logit(torch.tensor(opacity, dtype=torch.float64)).to(vertices) if soft else None
        mesh = cls(
            vertices=vertices,
            colors=start.detach().clone().to(vertices),
            opacity_logits=None if logit is None else logit.repeat(len(faces)),
            log_sigma=torch.tensor(sigma, dtype=torch.float64).log().to(vertices) if soft else None,
            topology=MeshTopology.from_faces(faces, len(vertices)),
            vertex_colored=vertex_colored,
        )
        for parameter in mesh.parameters().values():
            parameter.requires_grad_(True)
        return mesh

    def parameters(self) -> dict[str, Tensor]:
        """The learnable tensors by name."""
        parameters = {
            "vertices": self.vertices,
            "colors": self.colors,
            "opacity_logits": self.opacity_logits,
            "log_sigma": self.log_sigma,
        }
        return {name: parameter for name, parameter in parameters.items() if parameter is not None}

    @property
    def vertex_parameters(self) -> tuple[str, ...]:
        """Names of the parameters with one row per vertex."""
        return ("vertices", "colors") if self.vertex_colored else ("vertices",)

    @property
    def face_parameters(self) -> tuple[str, ...]:
        """Names of the parameters with one row per face."""
        colors = () if self.vertex_colored else ("colors",)
        return (*colors, "opacity_logits") if self.opacity_logits is not None else colors

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
        """In [0, 1], detached: the colours that an exported mesh carries."""
        return self.colors.detach().clamp(0.0, 1.0)

    def named(self, colors: Tensor) -> dict[str, Any]:
        """Colours of this mesh as an argument: {"face_colors": colors} or {"vertex_colors": colors}."""
        return {"vertex_colors" if self.vertex_colored else "face_colors": colors}
