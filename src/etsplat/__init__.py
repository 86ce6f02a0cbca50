"""Differentiable triangle splatting: posed images in, triangles out."""

from etsplat.core.cameras import Cameras, intrinsics, look_at, sphere_grid
from etsplat.core.errors import InputError
from etsplat.core.rasterization import Cutoffs, Rasterization, TriangleStatistics
from etsplat.ops.engines import num_threads, set_num_threads
from etsplat.ops.rasterize import rasterize

__all__ = [
    "Cameras",
    "Cutoffs",
    "InputError",
    "Rasterization",
    "TriangleStatistics",
    "intrinsics",
    "look_at",
    "num_threads",
    "rasterize",
    "set_num_threads",
    "sphere_grid",
]
