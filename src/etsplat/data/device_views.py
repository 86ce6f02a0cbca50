"""Training views where a step finds them by numbers in device memory, without the host (optim/step_queue.py)."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.captures import Capture

DEVICE_SHARE = 0.5
"""Photos stay on a GPU if they fill no more than this part of its free memory."""


@dataclass(frozen=True)
class PhotoKind:
    """What photos have in common that are drawn and compared by the same launches."""

    width: int
    height: int
    channels: int
    masked: bool


@dataclass
class _Stack:
    """Photos of one kind; where they are streamed there is room for one."""

    pixels: UInt8[Tensor, "P H W C"]
    masks: UInt8[Tensor, "P H W"] | None


class DeviceViews:
    """Cameras and photos of the training views on a device, the photos as bytes.

    A view has a kind, which decides what is launched, and a row of two numbers, which the launches read: its camera and
    the place of its photo among those of its kind. Where all photos fit they stay on the device. Where they do not,
    each kind has a single place, and a photo is uploaded there before its step.
    """

    def __init__(self, capture: Capture, device: torch.device) -> None:
        """Decodes and uploads all photos, unless they are streamed.

        Raises:
            InputError: a photo is damaged or has gone.
        """
        self._images, self._device = capture.images, device
        cameras = capture.cameras
        self._viewmats = torch.cat([camera.viewmats for camera in cameras]).to(device)
        self._Ks = torch.cat([camera.Ks for camera in cameras]).to(device)
        self._kinds: dict[int, PhotoKind] = {}
        self._places: dict[int, int] = {}
        self._stacks: dict[PhotoKind, _Stack] = {}
        self.streamed = self._images.streamed or not stay_on(device, capture.images.total_bytes)
        if not self.streamed:
            self._keep(capture.train)

    def expect(self, views: Sequence[int]) -> None:
        """These come next: photos that have to be decoded are decoded ahead of their turn."""
        if self.streamed:
            self._images.expect(views)

    def find(self, view: int) -> tuple[PhotoKind, list[float]]:
        """A view's kind, and its row."""
        if self.streamed and view not in self._kinds:
            self._kinds[view] = self._kind(view)
        return self._kinds[view], [float(view), float(self._places.get(view, 0))]

    def upload(self, view: int) -> Callable[[], None]:
        """What has to be done before the view's step, whenever that is made: queues the upload, or nothing."""
        if not self.streamed:
            return lambda: None
        kind = self._kinds[view]
        if kind not in self._stacks:
            self._stacks[kind] = self._room(kind, 1)
        stack, pixels, mask = self._stacks[kind], self._images[view], self._images.mask(view)

        def run() -> None:
            _copy(pixels, stack.pixels[0])
            if stack.masks is not None and mask is not None:
                _copy(mask, stack.masks[0])

        return run

    def look_up(
        self, kind: Hashable, row: Float[Tensor, "2"]
    ) -> tuple[Cameras, UInt8[Tensor, "1 H W C"], UInt8[Tensor, "1 H W"] | None]:
        """Of the view that a row belongs to, by launches that read the row.

        Args:
            kind: the view's, from `find`.
            row: (2,) from `find`, in device memory.

        Returns:
            Its camera; its photo of three channels, or four premultiplied; its mask, 255 where pixels count, None where
            all do.
        """
        assert isinstance(kind, PhotoKind)
        stack = self._stacks[kind]
        # Behind a step that does not count, all others read its row, whatever their kind: their place is anywhere.
        view, place = row[:1].long(), row[1:2].long().clamp_max(len(stack.pixels) - 1)
        viewmats, Ks = self._viewmats.index_select(0, view), self._Ks.index_select(0, view)
        mask = None if stack.masks is None else stack.masks.index_select(0, place)
        return Cameras(viewmats, Ks, kind.width, kind.height), stack.pixels.index_select(0, place), mask

    def _keep(self, views: Sequence[int]) -> None:
        counts: dict[PhotoKind, int] = {}
        for view in views:
            kind = self._kinds[view] = self._kind(view)
            self._places[view] = counts.get(kind, 0)
            counts[kind] = self._places[view] + 1
        self._stacks = {kind: self._room(kind, count) for kind, count in counts.items()}
        for view in views:
            stack, place = self._stacks[self._kinds[view]], self._places[view]
            stack.pixels[place].copy_(self._images[view])
            if stack.masks is not None:
                mask = self._images.mask(view)
                assert mask is not None
                stack.masks[place].copy_(mask)

    def _kind(self, view: int) -> PhotoKind:
        height, width, channels = self._images[view].shape
        return PhotoKind(width, height, channels, self._images.mask(view) is not None)

    def _room(self, kind: PhotoKind, count: int) -> _Stack:
        image = (count, kind.height, kind.width)
        pixels = torch.empty((*image, kind.channels), dtype=torch.uint8, device=self._device)
        masks = torch.empty(image, dtype=torch.uint8, device=self._device) if kind.masked else None
        return _Stack(pixels, masks)


def _copy(source: Tensor, target: Tensor) -> None:
    """Queued behind what reads the target now; torch keeps the pinned copy until it has been read."""
    pinned = source.pin_memory() if target.is_cuda else source
    target.copy_(pinned, non_blocking=True)


def stay_on(device: torch.device, size: int) -> bool:
    """Whether photos of so many bytes in all are kept on a device rather than uploaded when they are needed."""
    return device.type != "cuda" or size <= DEVICE_SHARE * torch.cuda.mem_get_info(device)[0]
