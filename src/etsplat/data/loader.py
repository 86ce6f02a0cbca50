"""Cameras, photos and masks of a data set on the device where a model is fitted to them."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import Pixels

DEVICE_SHARE = 0.5
"""Photos stay on a GPU if they fill no more than this part of its free memory."""


@dataclass(frozen=True)
class View:
    """What a step sees.

    Attributes:
        camera: one.
        photo: (1, H, W, C): bytes of 3 channels, or of 4 premultiplied; or float32 premultiplied RGBA.
        mask: (1, H, W), 255 where pixels count; None where all do.
        index: (1,) int64, of the view in its data set.
    """

    camera: Cameras
    photo: Tensor
    mask: UInt8[Tensor, "1 H W"] | None
    index: Int[Tensor, "1"]


@dataclass(frozen=True)
class PhotoKind:
    """What photos have in common that are drawn and compared by the same launches."""

    width: int
    height: int
    channels: int
    dtype: torch.dtype
    masked: bool


@dataclass
class _Stack:
    """Photos of one kind; where they are streamed there is room for those of one step."""

    pixels: Tensor
    masks: UInt8[Tensor, "P H W"] | None


class ViewLoader:
    """Views of a data set by index, or, for steps that are queued on a device, by numbers in its memory.

    For the latter (optim/step_queue.py) a view has a kind, which decides what is launched, and a place, which the
    launches read: its camera, and where its photo is among those of its kind. Where all photos fit they stay on the
    device. Where they do not, each kind has a place for each view of a step, and photos are uploaded there before it.

    Attributes:
        streamed: whether photos do not stay on the device, or not in memory.
    """

    def __init__(self, dataset: Dataset, device: torch.device, batch: int = 1) -> None:
        """Uploads the cameras.

        Args:
            dataset: whose views these are; only those in `dataset.train` can be queued.
            device: where views are wanted.
            batch: views of a queued step.
        """
        self._images, self._train, self._device, self._batch = dataset.images, dataset.train, device, batch
        self._cameras = [camera.to(device) for camera in dataset.cameras]
        self._viewmats = torch.cat([camera.viewmats for camera in self._cameras])
        self._Ks = torch.cat([camera.Ks for camera in self._cameras])
        self._indices = torch.arange(len(dataset), device=device)
        self._kept: dict[int, View] = {}
        self._kinds: dict[int, PhotoKind] = {}
        self._places: dict[int, int] = {}
        self._stacks: dict[PhotoKind, _Stack] = {}
        self.streamed = self._images.streamed or not stay_on(device, self._images.total_bytes)

    def expect(self, indices: Sequence[int]) -> None:
        """These come next: photos that have to be decoded are decoded ahead of their turn."""
        self._images.expect([index for index in indices if index not in self._kept])

    def view(self, index: int) -> View:
        """A view by its index.

        Raises:
            InputError: the photo is damaged or has gone.
        """
        if index in self._kept:
            return self._kept[index]
        mask, photo = self._images.mask(index), self._images[index].to(self._device)[None]
        mask = None if mask is None else mask.to(self._device)[None]
        view = View(self._cameras[index], photo, mask, self._indices[index : index + 1])
        if self._device.type == "cuda" and not self.streamed:
            self._kept[index] = view
        return view

    def kind_and_place(self, index: int, number: int = 0) -> tuple[Hashable, tuple[float, float]]:
        """Of a view that is to be queued. The first call uploads all photos of the training views if they can stay.

        Args:
            index: of the view.
            number: which view of its step it is.

        Raises:
            InputError: a photo is damaged or has gone.
        """
        if not self.streamed and not self._stacks:
            self._keep_all()
        if index not in self._kinds:
            self._kinds[index] = self._kind(index)
        return self._kinds[index], (float(index), float(self._places.get(index, number)))

    def upload(self, index: int, number: int = 0) -> Callable[[], None]:
        """What has to be done before the view's step, whenever that is made: queues the upload, or nothing.

        Args:
            index: of the view.
            number: which view of its step it is.
        """
        if not self.streamed:
            return lambda: None
        kind = self._kinds[index]
        if kind not in self._stacks:
            self._stacks[kind] = self._room(kind, self._batch)
        stack, pixels, mask = self._stacks[kind], self._images[index], self._images.mask(index)

        def run() -> None:
            _copy(pixels, stack.pixels[number])
            if stack.masks is not None and mask is not None:
                _copy(mask, stack.masks[number])

        return run

    def look_up(self, kind: Hashable, place: Float[Tensor, "2"]) -> View:
        """A queued view, by launches that read its place.

        Args:
            kind: from `kind_and_place`.
            place: (2,) from `kind_and_place`, in device memory.
        """
        assert isinstance(kind, PhotoKind)
        stack = self._stacks[kind]
        # Behind a step that does not count, all others read its row, whatever their kind: among several kinds, of which
        # one may have fewer photos than another, their place is anywhere.
        view, at = place.long().split(1)
        if len(self._stacks) > 1:
            at = at.clamp_max(len(stack.pixels) - 1)
        camera = Cameras(self._viewmats.index_select(0, view), self._Ks.index_select(0, view), kind.width, kind.height)
        mask = None if stack.masks is None else stack.masks.index_select(0, at)
        return View(camera, stack.pixels.index_select(0, at), mask, view)

    def _keep_all(self) -> None:
        counts: dict[PhotoKind, int] = {}
        for index in self._train:
            kind = self._kinds[index] = self._kind(index)
            self._places[index] = counts.get(kind, 0)
            counts[kind] = self._places[index] + 1
        self._stacks = {kind: self._room(kind, count) for kind, count in counts.items()}
        for index in self._train:
            stack, place = self._stacks[self._kinds[index]], self._places[index]
            stack.pixels[place].copy_(self._images[index])
            mask = self._images.mask(index)
            if stack.masks is not None and mask is not None:
                stack.masks[place].copy_(mask)

    def _kind(self, index: int) -> PhotoKind:
        photo = self._images[index]
        height, width, channels = photo.shape
        return PhotoKind(width, height, channels, photo.dtype, self._images.mask(index) is not None)

    def _room(self, kind: PhotoKind, count: int) -> _Stack:
        image = (count, kind.height, kind.width)
        pixels = torch.empty((*image, kind.channels), dtype=kind.dtype, device=self._device)
        masks = torch.empty(image, dtype=torch.uint8, device=self._device) if kind.masked else None
        return _Stack(pixels, masks)


def _copy(source: Pixels, target: Tensor) -> None:
    """Queued behind what reads the target now; torch keeps the pinned copy until it has been read."""
    pinned = source.pin_memory() if target.is_cuda and not source.is_cuda else source
    target.copy_(pinned, non_blocking=True)


def stay_on(device: torch.device, size: int) -> bool:
    """Whether photos of so many bytes in all are kept on a device rather than uploaded when they are needed."""
    return device.type != "cuda" or size <= DEVICE_SHARE * torch.cuda.mem_get_info(device)[0]
