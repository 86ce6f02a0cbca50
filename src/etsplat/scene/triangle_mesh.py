"""The learnable mesh of shape reconstruction."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.geometry.topology import MeshTopology


@dataclass
class TriangleMesh:
    """A triangle mesh with one colour and opacity per face and one softness for all (paper section 3.3).

    Colours are optimised as they are (not squashed) and clamped to [0, 1] where they leave as a mesh; opacities pass
    through a sigmoid and sigma through an exponential, so that every real parameter is a valid one.

    Attributes:
        vertices: (V, 3) positions in the unit frame, learnable.
        colors: (F, 3) face colours, learnable.
        opacity_logits: (F,) learnable.
        log_sigma: () learnable.
        topology: connectivity of the faces.
    """

    vertices: Float[Tensor, "V 3"]
    colors: Float[Tensor, "F 3"]
    opacity_logits: Float[Tensor, " F"]
    log_sigma: Float[Tensor, ""]
    topology: MeshTopology

    VERTEX_PARAMETERS = ("vertices",)
    FACE_PARAMETERS = ("colors", "opacity_logits")
    PARAMETERS = (*VERTEX_PARAMETERS, *FACE_PARAMETERS, "log_sigma")

    @classmethod
    def from_mesh(
        cls,
        vertices: Float[Tensor, "V 3"],
        faces: Int[Tensor, "F 3"],
        *,
        colors: Float[Tensor, "F 3"] | float,
        opacity: float,
        sigma: float,
    ) -> "TriangleMesh":
        """A mesh to start from.

        Args:
            vertices: (V, 3) positions in the unit frame.
            faces: (F, 3) vertex indices.
            colors: (F, 3), or one grey value for all faces, in [0, 1].
            opacity: of every face, in (0, 1).
            sigma: softness, > 0.
        """
        vertices = vertices.detach().clone()
        F = len(faces)
        start = colors if isinstance(colors, Tensor) else torch.full((F, 3), colors)
        logit = torch.logit(torch.tensor(opacity, dtype=torch.float64)).to(vertices.dtype)
        mesh = cls(
            vertices=vertices,
            colors=start.detach().clone().to(vertices),
            opacity_logits=logit.to(vertices.device).repeat(F),
            log_sigma=torch.tensor(sigma, dtype=torch.float64).log().to(vertices),
            topology=MeshTopology.from_faces(faces, len(vertices)),
        )
        for parameter in mesh.parameters().values():
            parameter.requires_grad_(True)
        return mesh

    def parameters(self) -> dict[str, Tensor]:
        """The learnable tensors by name."""
        return {name: getattr(self, name) for name in self.PARAMETERS}

    @property
    def faces(self) -> Int[Tensor, "F 3"]:
        """(F, 3) vertex indices."""
        return self.topology.faces

    @property
    def opacities(self) -> Float[Tensor, " F"]:
        """(F,) in (0, 1), differentiable."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def sigma(self) -> Float[Tensor, ""]:
        """The shared softness, > 0, differentiable."""
        return torch.exp(self.log_sigma)

    @property
    def display_colors(self) -> Float[Tensor, "F 3"]:
        """(F, 3) in [0, 1], detached: the colours that an exported mesh carries."""
        return self.colors.detach().clamp(0.0, 1.0)
