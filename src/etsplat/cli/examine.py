"""`etsplat doctor`: what this installation can do, and what is missing for what."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version

import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text

from etsplat import _native
from etsplat.core.cameras import Cameras, intrinsics
from etsplat.core.errors import EngineUnavailableError
from etsplat.engines.choice import engine
from etsplat.engines.cuda.compile import cache_folder
from etsplat.engines.cuda.device import Device
from etsplat.engines.threads import num_threads
from etsplat.engines.webgpu.device import gpu
from etsplat.metrics.image import find_lpips_weights
from etsplat.ops.rasterize import rasterize

TOLERANCE = 1e-4


def examine(console: Console) -> bool:
    """Print the state of the installation; whether everything that must work does."""
    difference = engine_difference()
    sound = difference <= TOLERANCE
    verdict = f"agrees with the reference to {difference:.0e}" if sound else f"WRONG: differs by {difference:.0e}"
    variable = os.environ.get("ETSPLAT_NUM_THREADS")
    origin = f"ETSPLAT_NUM_THREADS={variable}" if variable else "all usable cores; set ETSPLAT_NUM_THREADS to change"
    weights = find_lpips_weights(None)
    found = ", ".join(map(str, weights.paths)) or f"missing, so lpips in metrics.json is null: {weights.reason}"
    sections = (
        {
            "etsplat": version("etsplat"),
            "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
            "torch": str(torch.__version__),
            "numpy": version("numpy"),
        },
        {
            "engine": "cpu (native)",
            "instruction set": f"{_native.instruction_set()} of {', '.join(_native.available_instruction_sets())}",
            "threads": f"{num_threads()} ({origin})",
            "self-check": Text(verdict, style="" if sound else "bold red"),
        },
        {
            "LPIPS weights": found,
            "compiler": "not needed: the native engine is compiled already",
            "GPU (CUDA)": _gpu(),
            "GPU (WebGPU)": _webgpu(),
            "etsplat data sfm": _extra("sfm", "pycolmap"),
            "photos in HEIC": _extra("heic", "pillow-heif"),
            "etsplat view": _extra("viewer", "viser"),
            "videos": _extra("video", "imageio-ffmpeg"),
            "depth maps in EXR": _extra("depth", "OpenEXR"),
            "clouds in LAS": _extra("depth", "laspy"),
            "export --texture": _extra("texture", "xatlas"),
            "export --compress meshopt": _extra("compress", "meshoptimizer"),
            "--tensorboard": _extra("tensorboard", "tensorboard"),
            "--cluster auto": _extra("cluster", "ray"),
            "--cluster slurm": _extra("slurm", "submitit"),
            "--store s3://": _extra("s3", "s3fs"),
            "etsplat tune": _extra("tune", "optuna"),
        },
    )
    table = Table(box=None, show_header=False, pad_edge=False)
    for section in sections:
        table.add_section()
        for name, value in section.items():
            table.add_row(name, Text(value) if isinstance(value, str) else value)
    console.print(table)
    if not sound:
        console.print("The native engine computes wrong pictures here: reinstall etsplat, or use --engine reference.")
    return sound


def engine_difference() -> float:
    """Largest difference between the two engines' pictures of one soft triangle."""
    vertices = torch.tensor([[[-0.8, -0.6, 2.0], [0.9, -0.4, 2.5], [0.1, 0.8, 3.0]]])
    pictures = []
    for name in ("cpu", "reference"):
        with engine(name):
            drawn = rasterize(
                vertices,
                opacities=torch.tensor([0.8]),
                sigma=0.5,
                face_colors=torch.tensor([[0.9, 0.5, 0.2]]),
                cameras=Cameras(torch.eye(4)[None], intrinsics(60.0, 32, 32)[None], 32, 32),
            )
        pictures.append(drawn.color)
    return float((pictures[0] - pictures[1]).abs().max())


def _gpu() -> str:
    try:
        Device()
    except EngineUnavailableError as reason:
        return str(reason)
    return f"cuda, on {torch.cuda.get_device_name()}; compiled kernels in {cache_folder()}"


def _webgpu() -> str:
    try:
        return f"webgpu (draws, without gradients), on {gpu().name}"
    except EngineUnavailableError as reason:
        return str(reason)


def _extra(name: str, package: str) -> str:
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return f"missing: pip install 'etsplat[{name}]'"
