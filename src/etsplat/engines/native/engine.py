"""What engines of native code have in common."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from etsplat.core.rasterization import Rasterization, RasterizeSettings, RasterizeTensors
from etsplat.engines.engine import Engine
from etsplat.engines.native.plan import Render
from etsplat.engines.native.rasterize import rasterize_native


class NativeEngine(Engine, ABC):
    """Computes in float32 on one type of device.

    Attributes:
        place: its device in words.
        render: forward and backward pass of its rasterizer.
    """

    place: str
    render: type[Render]

    @abstractmethod
    def tensors_on(self) -> str:
        """Type of the device of its tensors."""

    def check(self, tensor: Tensor) -> None:
        """Float32 on its own device."""
        if tensor.device.type != self.tensors_on():
            raise ValueError(f"engine {self.name} needs tensors on {self.place}, got {tensor.device}")
        if tensor.dtype != torch.float32:
            raise ValueError(
                f"engine {self.name} computes in float32, got {tensor.dtype}: use .float() or engine reference"
            )

    def rasterize(self, tensors: RasterizeTensors, settings: RasterizeSettings) -> Rasterization:
        """See `etsplat.rasterize`."""
        return rasterize_native(self, self.render, tensors, settings)
