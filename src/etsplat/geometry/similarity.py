"""Turning, scaling and moving, in one record: how what is exported lies in the frame of its capture."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Similarity:
    """The map x' = scale * rotation x + translation, in float64.

    Attributes:
        rotation: (3, 3), of determinant 1.
        scale: > 0.
        translation: (3,), in units of x'.
    """

    rotation: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))
    scale: float = 1.0
    translation: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    @property
    def matrix(self) -> Float[Tensor, "4 4"]:
        """(4, 4) float64, for columns (x, y, z, 1): what files hold, row by row."""
        made = torch.eye(4, dtype=torch.float64)
        made[:3, :3], made[:3, 3] = self.scale * self.rotation, self.translation
        return made

    @property
    def moves(self) -> bool:
        """Whether it changes any point."""
        return not bool((self.matrix == torch.eye(4, dtype=torch.float64)).all())

    @classmethod
    def of_matrix(cls, matrix: Float[Tensor, "4 4"]) -> "Similarity":
        """The one that `matrix` is of, as it was read from a file."""
        turned = matrix[:3, :3].double()
        scale = float(torch.linalg.det(turned)) ** (1 / 3)
        return cls(turned / scale, scale, matrix[:3, 3].double())

    def apply(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """From x to x', float64."""
        return self.scale * (points.double() @ self.rotation.T) + self.translation

    def invert(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """From x' back to x, float64."""
        return (points.double() - self.translation) @ self.rotation / self.scale

    def moved(self, offset: Float[Tensor, "3"]) -> "Similarity":
        """The same, and then moved by an offset in units of x'."""
        return replace(self, translation=self.translation + offset.double())


def rotation_between(start: Float[Tensor, "3"], end: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes the unit vector `start` to the unit vector `end`, float64.

    Of opposite vectors it is half a turn about a coordinate axis, the first that `end` is not along, made
    perpendicular to `end`.
    """
    start, end = start.double(), end.double()
    axis, cosine = torch.linalg.cross(start, end), float(start @ end)
    identity = torch.eye(3, dtype=torch.float64)
    if cosine < -1 + 1e-9:
        about = next(row for row in identity if abs(float(row @ end)) < 0.9)
        about = torch.nn.functional.normalize(about - (about @ end) * end, dim=0)
        return 2 * about[:, None] * about[None] - identity
    x, y, z = axis.tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return identity + skew + skew @ skew / (1 + cosine)
