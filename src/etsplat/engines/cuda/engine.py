"""The engine "cuda": csrc/cuda, float32, on NVIDIA GPUs."""

from contextlib import AbstractContextManager, nullcontext
from functools import partial

import torch

from etsplat.engines.cuda.adam import adam_step
from etsplat.engines.cuda.antialias import Antialias
from etsplat.engines.cuda.launch import backend, device_type
from etsplat.engines.cuda.mesh_energies import mesh_energies
from etsplat.engines.cuda.normal_consistency import normal_consistency
from etsplat.engines.cuda.photometric import photometric_loss
from etsplat.engines.cuda.pick_values import pick_values
from etsplat.engines.cuda.queue import CudaQueuedSteps
from etsplat.engines.cuda.rasterize import CudaRender, per_corner
from etsplat.engines.cuda.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.engines.cuda.soup_activation import soup_activation
from etsplat.engines.cuda.soup_statistics import update_statistics
from etsplat.engines.cuda.spherical_harmonics import soup_colors, spherical_harmonics
from etsplat.engines.cuda.triangle_area import mean_area
from etsplat.engines.cuda.triangle_channels import run as run_triangle_channels
from etsplat.engines.cuda.weighted_sum import weighted_sum
from etsplat.engines.native.engine import NativeEngine
from etsplat.engines.native.plan import NativeCalls
from etsplat.engines.native.rasterize import rasterize_native
from etsplat.engines.native.triangle_channels import triangle_channels

_CALLS = NativeCalls(CudaRender, run_triangle_channels, pick_values, per_corner)


class CudaEngine(NativeEngine):
    """Has all operations, so that nothing comes back to the host within a step."""

    name = "cuda"
    device = "cuda"
    place = "a GPU"
    queued = CudaQueuedSteps()

    def tensors_on(self) -> str:
        """The tests' shim computes on the CPU."""
        return device_type()

    def home(self) -> torch.device:
        """The current GPU."""
        backend()
        return torch.device(device_type())

    def looping(self) -> AbstractContextManager[None]:
        """Torch as it is set."""
        return nullcontext()

    adam_step = staticmethod(adam_step)
    antialias = staticmethod(Antialias.apply)
    mean_area = staticmethod(mean_area)
    mesh_energies = staticmethod(mesh_energies)
    normal_consistency = staticmethod(normal_consistency)
    photometric_loss = staticmethod(photometric_loss)
    pick_values = staticmethod(pick_values)
    rasterize = staticmethod(partial(rasterize_native, _CALLS))
    rasterize_opaque = staticmethod(rasterize_opaque)
    render_opaque = staticmethod(render_opaque)
    soup_activation = staticmethod(soup_activation)
    soup_colors = staticmethod(soup_colors)
    spherical_harmonics = staticmethod(spherical_harmonics)
    triangle_channels = staticmethod(partial(triangle_channels, run_triangle_channels))
    update_statistics = staticmethod(update_statistics)
    weighted_sum = staticmethod(weighted_sum)
