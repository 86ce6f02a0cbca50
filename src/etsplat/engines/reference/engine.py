"""The engine "reference": plain PyTorch, on any device, in any precision."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from etsplat.engines.engine import Engine
from etsplat.engines.reference.adam import adam_step
from etsplat.engines.reference.antialias import antialias
from etsplat.engines.reference.mesh_energies import mesh_energies
from etsplat.engines.reference.normal_consistency import normal_consistency
from etsplat.engines.reference.photometric import photometric_loss
from etsplat.engines.reference.pick_values import pick_values
from etsplat.engines.reference.rasterize import rasterize
from etsplat.engines.reference.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.engines.reference.soup_activation import soup_activation
from etsplat.engines.reference.soup_statistics import update_statistics
from etsplat.engines.reference.spherical_harmonics import soup_colors, spherical_harmonics
from etsplat.engines.reference.triangle_area import mean_area
from etsplat.engines.reference.triangle_channels import triangle_channels
from etsplat.engines.reference.weighted_sum import weighted_sum


class ReferenceEngine(Engine):
    """Reads like the paper; gradients by autograd. An engine inherits from it what it has no code of its own for."""

    name = "reference"
    device = None
    queued = None

    def check(self, tensor: Tensor) -> None:
        """Everything will do."""

    def home(self) -> torch.device:
        """The CPU, in spite of being able to compute elsewhere."""
        return torch.device("cpu")

    def looping(self) -> AbstractContextManager[None]:
        """Torch as it is set."""
        return nullcontext()

    adam_step = staticmethod(adam_step)
    antialias = staticmethod(antialias)
    mean_area = staticmethod(mean_area)
    mesh_energies = staticmethod(mesh_energies)
    normal_consistency = staticmethod(normal_consistency)
    photometric_loss = staticmethod(photometric_loss)
    pick_values = staticmethod(pick_values)
    rasterize = staticmethod(rasterize)
    rasterize_opaque = staticmethod(rasterize_opaque)
    render_opaque = staticmethod(render_opaque)
    soup_activation = staticmethod(soup_activation)
    soup_colors = staticmethod(soup_colors)
    spherical_harmonics = staticmethod(spherical_harmonics)
    triangle_channels = staticmethod(triangle_channels)
    update_statistics = staticmethod(update_statistics)
    weighted_sum = staticmethod(weighted_sum)
