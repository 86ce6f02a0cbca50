"""The engine "cuda": csrc/cuda, float32, on NVIDIA GPUs."""

import torch

from etsplat.engines.cuda.antialias import antialias, interpolate, texture_detail
from etsplat.engines.cuda.channels import channels_backward, channels_forward, pick_values
from etsplat.engines.cuda.launch import backend, device_type
from etsplat.engines.cuda.losses import mean_area, mesh_energies, normal_consistency, photometric_loss, weighted_sum
from etsplat.engines.cuda.rasterize import CudaRender
from etsplat.engines.cuda.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.engines.cuda.soup import soup_activation, soup_colors, spherical_harmonics
from etsplat.engines.cuda.steps import CudaQueuedSteps, adam_step, update_statistics
from etsplat.engines.cuda.texture import sample_texture
from etsplat.engines.native.engine import NativeEngine
from etsplat.engines.native.triangle_channels import triangle_channels


class CudaEngine(NativeEngine):
    """Has all operations, so that nothing comes back to the host within a step."""

    name = "cuda"
    device = "cuda"
    place = "a GPU"
    queued = CudaQueuedSteps()
    render = CudaRender

    def tensors_on(self) -> str:
        """The tests' shim computes on the CPU."""
        return device_type()

    def home(self) -> torch.device:
        """The current GPU."""
        backend()
        return torch.device(device_type())

    adam_step = staticmethod(adam_step)
    antialias = staticmethod(antialias)
    interpolate = staticmethod(interpolate)
    mean_area = staticmethod(mean_area)
    mesh_energies = staticmethod(mesh_energies)
    normal_consistency = staticmethod(normal_consistency)
    photometric_loss = staticmethod(photometric_loss)
    pick_values = staticmethod(pick_values)
    rasterize_opaque = staticmethod(rasterize_opaque)
    render_opaque = staticmethod(render_opaque)
    sample_texture = staticmethod(sample_texture)
    soup_activation = staticmethod(soup_activation)
    soup_colors = staticmethod(soup_colors)
    spherical_harmonics = staticmethod(spherical_harmonics)
    texture_detail = staticmethod(texture_detail)
    triangle_channels = staticmethod(triangle_channels(channels_forward, channels_backward))
    update_statistics = staticmethod(update_statistics)
    weighted_sum = staticmethod(weighted_sum)
