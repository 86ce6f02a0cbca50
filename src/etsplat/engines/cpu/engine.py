"""The engine "cpu": csrc/cpu, float32."""

from contextlib import AbstractContextManager

from etsplat import _native
from etsplat.engines.cpu.adam import adam_step
from etsplat.engines.cpu.antialias import antialias, interpolate, rasterize_behind, texture_detail
from etsplat.engines.cpu.losses import mean_area, mesh_energies, normal_consistency, photometric_loss
from etsplat.engines.cpu.rasterize import CpuRender
from etsplat.engines.cpu.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.engines.cpu.soup import soup_activation, soup_colors, spherical_harmonics
from etsplat.engines.cpu.texture import sample_texture
from etsplat.engines.native.engine import NativeEngine
from etsplat.engines.native.triangle_channels import triangle_channels
from etsplat.engines.threads import one_torch_thread


class CpuEngine(NativeEngine):
    """Inherits from the reference what is no more than a few operations of torch."""

    name = "cpu"
    device = "cpu"
    place = "the CPU"
    render = CpuRender

    def tensors_on(self) -> str:
        """The CPU."""
        return "cpu"

    def looping(self) -> AbstractContextManager[None]:
        """The other threads are the engine's."""
        return one_torch_thread()

    adam_step = staticmethod(adam_step)
    antialias = staticmethod(antialias)
    interpolate = staticmethod(interpolate)
    mean_area = staticmethod(mean_area)
    mesh_energies = staticmethod(mesh_energies)
    normal_consistency = staticmethod(normal_consistency)
    photometric_loss = staticmethod(photometric_loss)
    rasterize_behind = staticmethod(rasterize_behind)
    rasterize_opaque = staticmethod(rasterize_opaque)
    render_opaque = staticmethod(render_opaque)
    sample_texture = staticmethod(sample_texture)
    soup_activation = staticmethod(soup_activation)
    soup_colors = staticmethod(soup_colors)
    spherical_harmonics = staticmethod(spherical_harmonics)
    texture_detail = staticmethod(texture_detail)
    triangle_channels = staticmethod(triangle_channels(_native.triangle_channels, _native.triangle_channels_backward))
