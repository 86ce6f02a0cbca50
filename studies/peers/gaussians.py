"""Gaussians of the peers: their parameters, their start, their pictures through gsplat, their file."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.harmonics import SH_CONSTANT
from etsplat.io.tensors import save_tensors
from etsplat.model.soup_init import StartPoints, spacing
from studies.peers.settings import PeerConfig

NAMES = ("means", "scales", "quats", "opacities", "sh0", "shN")
"""As gsplat's strategies want them: log scales, (w, x, y, z), opacities before their sigmoid, harmonics."""
_LOG_THICKNESS = -23.0
"""Of 2D Gaussians. gsplat draws them as if it were nothing, but its strategy measures and splits them by all scales."""


@dataclass(frozen=True)
class Splatting:
    """What gsplat returns for one camera.

    Attributes:
        color: over the background.
        normals: of the Gaussians and of the depth image, and what is opaque; None for 3dgs.
        info: for the strategy.
    """

    color: Float[Tensor, "1 H W 3"]
    normals: tuple[Float[Tensor, "1 H W 3"], Float[Tensor, "*C H W 3"], Float[Tensor, "1 H W 1"]] | None
    info: dict[str, Any]


def start_gaussians(points: StartPoints, config: PeerConfig, generator: torch.Generator) -> nn.ParameterDict:
    """A ball, or for 2dgs a disk, at each point, as large as the gap to its neighbours, turned at random."""
    count = len(points)
    scales = spacing(points.positions).log()[:, None].repeat(1, 3)
    if config.method == "2dgs":
        scales[:, 2] = _LOG_THICKNESS
    harmonics = torch.zeros(count, (config.sh_degree + 1) ** 2, 3)
    harmonics[:, 0] = (points.colors - 0.5) / SH_CONSTANT
    values = {
        "means": points.positions,
        "scales": scales,
        "quats": torch.rand(count, 4, generator=generator),
        "opacities": torch.full((count,), math.log(config.start_opacity / (1 - config.start_opacity))),
        "sh0": harmonics[:, :1],
        "shN": harmonics[:, 1:],
    }
    return nn.ParameterDict({name: nn.Parameter(values[name].contiguous()) for name in NAMES})


def splat(
    gsplat: Any,
    gaussians: nn.ParameterDict,
    camera: Cameras,
    config: PeerConfig,
    background: Float[Tensor, "1 3"],
    *,
    sh_degree: int | None = None,
    normals: bool = False,
) -> Splatting:
    """The picture of one camera, not clamped.

    Args:
        gsplat: the module.
        gaussians: parameters, on the camera's device.
        camera: one.
        config: which peer.
        background: behind the Gaussians.
        sh_degree: highest band that is used; None for all.
        normals: of 2dgs, return normals as well.
    """
    arguments = {
        "means": gaussians["means"],
        "quats": gaussians["quats"],
        "scales": gaussians["scales"].exp(),
        "opacities": gaussians["opacities"].sigmoid(),
        "colors": torch.cat([gaussians["sh0"], gaussians["shN"]], dim=1),
        "viewmats": camera.viewmats,
        "Ks": camera.Ks,
        "width": camera.width,
        "height": camera.height,
        "near_plane": config.near_plane,
        "sh_degree": config.sh_degree if sh_degree is None else sh_degree,
        "packed": False,
        "backgrounds": background,
    }
    if config.method == "3dgs":
        color, _, info = gsplat.rasterization(**arguments)
        return Splatting(color, None, info)
    mode = "RGB+ED" if normals else "RGB"
    color, alpha, drawn, of_depth, _, _, info = gsplat.rasterization_2dgs(**arguments, render_mode=mode)
    return Splatting(color[..., :3], (drawn, of_depth, alpha) if normals else None, info)


def save_gaussians(path: Path, gaussians: nn.ParameterDict) -> None:
    """Atomic. Raises InputError if the file cannot be written."""
    save_tensors(path, {name: gaussians[name] for name in NAMES})


def load_gaussians(path: Path, device: torch.device) -> nn.ParameterDict:
    """What `save_gaussians` wrote.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        tensors = load_file(path)
        return nn.ParameterDict({name: nn.Parameter(tensors[name].to(device)) for name in NAMES})
    except (OSError, KeyError, SafetensorError) as error:
        raise InputError(f"{path}: cannot be read ({str(error).splitlines()[0]}); delete the run's folder") from error
