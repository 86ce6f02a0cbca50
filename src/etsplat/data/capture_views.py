"""Cameras, photos and masks of a capture on the device where a soup is fitted to them."""

from collections.abc import Sequence

import torch
from jaxtyping import UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.captures import Capture


class CaptureViews:
    """Views by index. On a GPU photos stay as bytes once they are there, unless the capture is streamed.

    Attributes:
        cameras: one for each view.
    """

    def __init__(self, capture: Capture, device: torch.device) -> None:
        self.cameras: list[Cameras] = [camera.to(device) for camera in capture.cameras]
        self._images = capture.images
        self._device = device
        self._kept: dict[int, tuple[Tensor, Tensor | None]] = {}

    def expect(self, views: Sequence[int]) -> None:
        """These come next; photos that have to be decoded are decoded ahead of their turn."""
        self._images.expect([view for view in views if view not in self._kept])

    def photo(self, view: int) -> UInt8[Tensor, "H W C"]:
        """Three channels, or four premultiplied."""
        return self._view(view)[0]

    def mask(self, view: int) -> UInt8[Tensor, "H W"] | None:
        """255 where pixels count; None where all do."""
        return self._view(view)[1]

    def _view(self, view: int) -> tuple[Tensor, Tensor | None]:
        if view in self._kept:
            return self._kept[view]
        mask = self._images.mask(view)
        on_device = self._images[view].to(self._device), None if mask is None else mask.to(self._device)
        if self._device.type == "cuda" and not self._images.streamed:
            self._kept[view] = on_device
        return on_device
