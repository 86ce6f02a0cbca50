"""Where up is in a capture: as its place in the world says, or as its cameras were held."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.io.georeference import Georeference

_AGREE = 0.3
"""Length of the mean of the cameras' own up directions, at least, for them not to contradict each other."""

_LEVEL, _TURNED = 0.01, 0.03
"""Mean squares of what the cameras' right sides have along up, at most, and along the next direction, at least."""

_FARTHEST = math.cos(1.0)
"""Of what the right sides are level with, along the cameras' mean up direction, at least."""


def up_of(capture: Dataset) -> Float[Tensor, "3"] | None:
    """Where up is, a unit vector, float64; None where nothing says it, as the cameras contradict each other.

    What says where the capture lies in the world is asked first (`Georeference.up`): photos that look straight down, as
    those of drones, have their own up directions along the ground.
    """
    told = told_up(capture.georeference)
    return held_up(capture.viewmats) if told is None else told


def told_up(georeference: Georeference | None) -> Float[Tensor, "3"] | None:
    """Where up is by what is said of the place in the world, float64; None where that does not say it."""
    if georeference is None or georeference.up is None:
        return None
    return torch.eye(3, dtype=torch.float64)["xyz".index(georeference.up)]


def noted_up(note: str | None) -> Float[Tensor, "3"] | None:
    """Where up is by the note of a soup from a file, float64; None where it has no such note, or no usable one."""
    try:
        up = torch.tensor([float(word) for word in (note or "").split()], dtype=torch.float64)
    except ValueError:
        return None
    return up if up.shape == (3,) and abs(float(up.norm()) - 1) < 1e-6 else None


def held_up(viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "3"] | None:
    """Where up is by how cameras were held, float64; None if they contradict each other.

    What their right sides are level with, where they say so together. Else, where cameras stand side by side or were
    held on edge, the mean of their own up directions, which leans back where all look up at something, as at a front.

    Args:
        viewmats: (B, 4, 4) world to camera.
    """
    viewmats = viewmats.double()
    mean = -viewmats[:, 1, :3].mean(dim=0)
    if float(mean.norm()) <= _AGREE:
        return None
    mean = torch.nn.functional.normalize(mean, dim=0)
    right = viewmats[:, 0, :3]
    values, vectors = torch.linalg.eigh(right.T @ right / len(right))
    level = vectors[:, 0] * torch.sign(vectors[:, 0] @ mean)
    sure = float(values[0]) < _LEVEL and float(values[1]) > _TURNED and float(level @ mean) > _FARTHEST
    return level if sure else mean
