"""Differentiable triangle splatting: posed images in, triangles out.

Names are imported when they are first used, so that `import etsplat` and the command line's help do not wait for torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from etsplat.core.cameras import Cameras, intrinsics, look_at, sphere_grid
    from etsplat.core.errors import InputError
    from etsplat.core.rasterization import Cutoffs, Rasterization, TriangleStatistics
    from etsplat.data.demo_object import demo_object
    from etsplat.io.mesh_files import MeshFile, load_mesh, save_mesh
    from etsplat.ops.antialias import rasterize_antialiased
    from etsplat.ops.engines import num_threads, set_num_threads
    from etsplat.ops.rasterize import rasterize
    from etsplat.ops.rasterize_hard import HardRasterization, rasterize_hard, render_opaque
    from etsplat.report.html import write_report
    from etsplat.tasks.reconstruct import ReconstructResult, reconstruct
    from etsplat.tasks.reconstruct_config import PRESETS, ReconstructConfig
    from etsplat.tasks.train import TrainResult, train
    from etsplat.tasks.train_config import TrainConfig, train_settings

_HOMES = {
    "etsplat.core.cameras": ("Cameras", "intrinsics", "look_at", "sphere_grid"),
    "etsplat.core.errors": ("InputError",),
    "etsplat.core.rasterization": ("Cutoffs", "Rasterization", "TriangleStatistics"),
    "etsplat.io.mesh_files": ("MeshFile", "load_mesh", "save_mesh"),
    "etsplat.ops.antialias": ("rasterize_antialiased",),
    "etsplat.ops.engines": ("num_threads", "set_num_threads"),
    "etsplat.ops.rasterize": ("rasterize",),
    "etsplat.ops.rasterize_hard": ("HardRasterization", "rasterize_hard", "render_opaque"),
    "etsplat.report.html": ("write_report",),
    "etsplat.data.demo_object": ("demo_object",),
    "etsplat.tasks.reconstruct": ("ReconstructResult", "reconstruct"),
    "etsplat.tasks.reconstruct_config": ("PRESETS", "ReconstructConfig"),
    "etsplat.tasks.train": ("TrainResult", "train"),
    "etsplat.tasks.train_config": ("TrainConfig", "train_settings"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "PRESETS",
    "Cameras",
    "Cutoffs",
    "HardRasterization",
    "InputError",
    "MeshFile",
    "Rasterization",
    "ReconstructConfig",
    "ReconstructResult",
    "TrainConfig",
    "TrainResult",
    "TriangleStatistics",
    "demo_object",
    "intrinsics",
    "load_mesh",
    "look_at",
    "num_threads",
    "rasterize",
    "rasterize_antialiased",
    "rasterize_hard",
    "reconstruct",
    "render_opaque",
    "save_mesh",
    "set_num_threads",
    "sphere_grid",
    "train",
    "train_settings",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'etsplat' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
