"""The engine "webgpu": draws triangle soups on any GPU; everything else is computed by the engine "cpu"."""

import torch

from etsplat.engines.cpu.engine import CpuEngine
from etsplat.engines.webgpu.device import gpu
from etsplat.engines.webgpu.rasterize import WebGpuRender


class WebGpuEngine(CpuEngine):
    """Takes float32 tensors of the CPU, and gives such; it is never chosen by itself."""

    name = "webgpu"
    device = None
    differentiates = False
    render = WebGpuRender

    def computes_on(self, device: str) -> bool:
        """It brings tensors of the CPU to the GPU by itself."""
        return device == "cpu"

    def home(self) -> torch.device:
        """The CPU, if there is a GPU that draws."""
        gpu()
        return torch.device("cpu")
