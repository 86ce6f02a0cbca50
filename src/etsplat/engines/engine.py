"""What an engine is: one method for each operation of `etsplat.ops`, which has checked the arguments."""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.reference.antialias import antialias, interpolate, texture_detail
from etsplat.engines.reference.channels import pick_values, triangle_channels
from etsplat.engines.reference.losses import (
    mean_area,
    mesh_energies,
    normal_consistency,
    photometric_loss,
    weighted_sum,
)
from etsplat.engines.reference.rasterize import rasterize
from etsplat.engines.reference.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.engines.reference.soup import soup_activation, soup_colors, spherical_harmonics
from etsplat.engines.reference.steps import adam_step, update_statistics
from etsplat.engines.reference.texture import sample_texture


class Engine:
    """The engine "reference": plain PyTorch, on any device, in any precision; gradients by autograd.

    Others inherit from it what they have no code of their own for. Tensors come as the public functions describe them,
    on one device and in one precision, but not always contiguous. Results are differentiable wherever the public
    function says so. Operations are static: an engine has no state but what its device has.

    Attributes:
        name: by which it is chosen: `with etsplat.engine(name)`.
        device: type of the devices on which it is chosen by itself, for float32; None if it never is.
        differentiates: whether it has the gradients of the rasterizer, so that one can train on it.
        rasterize_behind: what is nearest and what is behind it (`model/behind.py`) at once; None where each is drawn.
        queued: how steps are queued on it, as `engines/cuda/steps.py` does; None where each step returns to the host.
    """

    name: str = "reference"
    device: str | None = None
    differentiates: bool = True
    rasterize_behind: Any = None
    queued: Any = None

    @property
    def queues_steps(self) -> bool:
        """Whether steps can run one after the other without the host looking in between."""
        return self.queued is not None

    def computes_on(self, device: str) -> bool:
        """Whether it takes tensors on devices of this type."""
        return self.device in (None, device)

    def check(self, tensor: Tensor) -> None:
        """Raises ValueError where it does not compute with tensors of this device or dtype."""

    def home(self) -> torch.device:
        """Where a task puts its tensors if nobody says where.

        Raises:
            EngineUnavailableError: It cannot run here.
        """
        return torch.device("cpu")

    def looping(self) -> AbstractContextManager[None]:
        """What a loop of steps runs in."""
        return nullcontext()

    adam_step = staticmethod(adam_step)
    antialias = staticmethod(antialias)
    interpolate = staticmethod(interpolate)
    mean_area = staticmethod(mean_area)
    mesh_energies = staticmethod(mesh_energies)
    normal_consistency = staticmethod(normal_consistency)
    photometric_loss = staticmethod(photometric_loss)
    pick_values = staticmethod(pick_values)
    rasterize = staticmethod(rasterize)
    rasterize_opaque = staticmethod(rasterize_opaque)
    render_opaque = staticmethod(render_opaque)
    sample_texture = staticmethod(sample_texture)
    soup_activation = staticmethod(soup_activation)
    soup_colors = staticmethod(soup_colors)
    spherical_harmonics = staticmethod(spherical_harmonics)
    texture_detail = staticmethod(texture_detail)
    triangle_channels = staticmethod(triangle_channels)
    update_statistics = staticmethod(update_statistics)
    weighted_sum = staticmethod(weighted_sum)
