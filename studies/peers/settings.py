"""Settings of the Gaussian peers that `python -m studies.nvs` runs beside our methods. Imports no torch."""

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from etsplat.core.errors import InputError
from etsplat.tasks.settings import Settings

if TYPE_CHECKING:
    import torch

Peer = Literal["3dgs", "2dgs"]
PEERS: tuple[Peer, ...] = get_args(Peer)

Schedule = Literal["scaled", "own"]
"""OpenSplat's settings for 30,000 steps, scaled to the length of a run or as they are."""


@dataclass(frozen=True)
class PeerConfig(Settings):
    """3D Gaussian splatting (Kerbl et al. 2023) or 2D Gaussian splatting (Huang et al. 2024), in gsplat.

    Learning rates, losses and densification are those of their papers, lengths relative to the scene's extent. What
    happens at an iteration is given for `schedule_length` iterations and scales, as with our methods. Intervals do not:
    Gaussians that have no time to settle are split again and again. Made by `peer_config`, which knows what differs
    between the two: the values here are those of 3dgs.
    """

    TASK: ClassVar[str] = "peer"

    method: Peer
    """Which."""
    iterations: int = 30_000
    """Optimization steps; each sees one view."""
    schedule_length: int = 30_000
    """What the iterations below refer to."""
    max_epochs: int | None = None
    """As in `TrainConfig`."""
    width: int | None = None
    """As in `TrainConfig`."""
    background: Literal["black", "white"] = "black"
    """Behind the scene."""
    seed: int = 0
    """Of the start and the order of the views."""
    start_points: int = 100_000
    """So many random Gaussians where the capture has no points."""

    start_opacity: float = 0.1
    """Of all Gaussians."""
    sh_degree: int = 3
    """Of the view-dependent colours."""
    sh_every: int = 1000
    """Iterations between steps of the degree, from 0."""
    lr_means: float = 1.6e-4
    """Adam learning rate of positions, where the scene's extent is 1."""
    lr_means_final: float = 0.01
    """Ratio of that rate's last value to its first; it falls exponentially."""
    lr_scales: float = 5e-3
    """Of log scales."""
    lr_quats: float = 1e-3
    """Of rotations."""
    lr_opacities: float = 5e-2
    """Of opacities, before their sigmoid."""
    lr_sh_dc: float = 2.5e-3
    """Of the constant band of the colours."""
    lr_sh_rest: float = 1.25e-4
    """Of the other bands."""
    lambda_dssim: float = 0.2
    """Share of 1 - SSIM in the photometric loss; the rest is L1."""
    lambda_normal: float = 0.05
    """2dgs: weight of the angle between normals and those of the depth image."""
    normals_from: int = 7000
    """Where that begins."""
    near_plane: float = 0.01
    """What is nearer to a camera is not drawn; 0.2 for 2dgs, as gsplat's trainers have it."""

    densify_from: int = 500
    """No densification up to this iteration."""
    densify_until: int = 15_000
    """None from this one on."""
    densify_every: int = 100
    """Iterations between densifications, however long the run is."""
    reset_every: int = 3000
    """Iterations between resets of the opacities while there is densification, however long the run is."""
    prune_opacity: float = 0.005
    """Densification removes what is less opaque, a reset leaves nothing more opaque than twice this; 0.05 for 2dgs."""

    def at(self, step: int) -> int:
        """The iteration of this run that an iteration of the schedule falls on; at least 1."""
        return max(1, round(step * self.iterations / self.schedule_length))

    def resets_after(self, iteration: int) -> bool:
        """Whether opacities are reset at the end of an iteration, counted from 1."""
        step = iteration - 1  # gsplat counts from 0
        return 0 < step < self.at(self.densify_until) and step % self.reset_every == 0


def peer_config(method: Peer, **changes: Any) -> PeerConfig:
    """The settings of a peer, but for what is changed."""
    own = {"near_plane": 0.2, "prune_opacity": 0.05} if method == "2dgs" else {}
    return PeerConfig(method, **{**own, **changes})


def load_gsplat() -> "tuple[Any, torch.device]":
    """The module gsplat, and the device that it computes on.

    Raises:
        InputError: it is not installed, or there is no GPU, without which it computes nothing.
    """
    try:
        gsplat = importlib.import_module("gsplat")
    except ImportError as error:
        raise InputError("methods 3dgs and 2dgs need gsplat: pip install --group studies") from error
    import torch

    if not torch.cuda.is_available():
        raise InputError("methods 3dgs and 2dgs need an NVIDIA GPU, which gsplat computes on; leave them out")
    return gsplat, torch.device("cuda")
