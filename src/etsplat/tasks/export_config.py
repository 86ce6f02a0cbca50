"""Settings of the export of soups. Imports no torch: the command line reads them for its help."""

from dataclasses import dataclass
from typing import Annotated, Literal

from etsplat.tasks.settings import Range, Settings

Bake = Literal["mean", "constant", "keep"]


@dataclass(frozen=True)
class ExportConfig(Settings):
    """How a soup leaves for other programs."""

    colors: Bake = "mean"
    """What becomes of colours that depend on the direction.
    mean: one per triangle, of what the training views see;
    constant: one per triangle, the constant part of its harmonics;
    keep: that, and the harmonics beside it (PLY only): the file comes back with the same colours from every side."""
    min_opacity: Annotated[float | None, Range(0, 1)] = None
    """Leave out triangles less opaque than this; by default 0.5, as `etsplat render --opaque` does."""
    alpha: bool = False
    """Write opacities as alpha too (PLY, OFF, GLB). Most viewers sort transparent triangles badly."""
    weld: bool = False
    """Let triangles share vertices where positions and colours are equal."""
    up: Literal["y", "keep"] = "y"
    """Turn the scene so that the training cameras' mean up direction is +y, or keep the capture's axes."""
