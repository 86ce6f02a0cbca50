"""Cameras, photos and masks of a data set on the device where a model is fitted to them."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import overload

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import Picture

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
        depth: (1, H, W) along the optical axis, in units of the data set's frame, 0 where not known; None without.
    """

    camera: Cameras
    photo: Tensor
    mask: UInt8[Tensor, "1 H W"] | None
    index: Int[Tensor, "1"]
    depth: Float[Tensor, "1 H W"] | None = None


@dataclass(frozen=True)
class PhotoKind:
    """What photos have in common that are drawn and compared by the same launches."""

    width: int
    height: int
    channels: int
    dtype: torch.dtype
    masked: bool
    deep: bool = False


@dataclass
class _Stack:
    """Photos of one kind; where they are streamed there is room for those of one step."""

    pixels: Tensor
    masks: UInt8[Tensor, "P H W"] | None
    depths: Float[Tensor, "P H W"] | None

    def put(self, picture: Picture, place: int) -> None:
        """A photo in its place; queued behind what reads it now."""
        _copy(picture.pixels, self.pixels[place])
        for source, target in ((picture.mask, self.masks), (picture.depth, self.depths)):
            if source is not None and target is not None:
                _copy(source, target[place])


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
        self._radius = dataset.normalization.radius
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
        picture = self._picture(index)
        photo, mask, depth = (
            None if plane is None else plane.to(self._device)[None]
            for plane in (picture.pixels, picture.mask, picture.depth)
        )
        assert photo is not None
        view = View(self._cameras[index], photo, mask, self._indices[index : index + 1], depth)
        if self._device.type == "cuda" and not self.streamed:
            self._kept[index] = view
        return view

    def views(self, indices: Sequence[int], seen: Callable[[View], View] = lambda view: view) -> "Views":
        """Some by their indices, each loaded when it is looked at, and handed to `seen`."""
        return Views(self, indices, seen)

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
        stack, picture = self._stacks[kind], self._picture(index)
        return lambda: stack.put(picture, number)

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
        depth = None if stack.depths is None else stack.depths.index_select(0, at)
        return View(camera, stack.pixels.index_select(0, at), mask, view, depth)

    def _keep_all(self) -> None:
        counts: dict[PhotoKind, int] = {}
        for index in self._train:
            kind = self._kinds[index] = self._kind(index)
            self._places[index] = counts.get(kind, 0)
            counts[kind] = self._places[index] + 1
        self._stacks = {kind: self._room(kind, count) for kind, count in counts.items()}
        for index in self._train:
            self._stacks[self._kinds[index]].put(self._picture(index), self._places[index])

    def _picture(self, index: int) -> Picture:
        """With its depth in units of the data set's frame."""
        picture = self._images.picture(index)
        return picture if picture.depth is None else replace(picture, depth=picture.depth / self._radius)

    def _kind(self, index: int) -> PhotoKind:
        picture = self._images.picture(index)
        height, width, channels = picture.pixels.shape
        known = picture.mask is not None, picture.depth is not None
        return PhotoKind(width, height, channels, picture.pixels.dtype, *known)

    def _room(self, kind: PhotoKind, count: int) -> _Stack:
        image = (count, kind.height, kind.width)
        pixels = torch.empty((*image, kind.channels), dtype=kind.dtype, device=self._device)
        masks = torch.empty(image, dtype=torch.uint8, device=self._device) if kind.masked else None
        depths = torch.empty(image, device=self._device) if kind.deep else None
        return _Stack(pixels, masks, depths)


class Views(Sequence[View]):
    """Views of a loader, each loaded when it is looked at."""

    def __init__(self, loader: ViewLoader, indices: Sequence[int], seen: Callable[[View], View]) -> None:
        self._loader, self._indices, self._seen = loader, indices, seen

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, place: int) -> View: ...

    @overload
    def __getitem__(self, place: slice) -> "Views": ...

    def __getitem__(self, place: int | slice) -> "View | Views":
        """Raises InputError where a photo is damaged or has gone."""
        if isinstance(place, slice):
            return Views(self._loader, self._indices[place], self._seen)
        return self._seen(self._loader.view(self._indices[place]))


def _copy(source: Tensor, target: Tensor) -> None:
    """Queued behind what reads the target now; torch keeps the pinned copy until it has been read."""
    pinned = source.pin_memory() if target.is_cuda and not source.is_cuda else source
    target.copy_(pinned, non_blocking=True)


def stay_on(device: torch.device, size: int) -> bool:
    """Whether photos of so many bytes in all are kept on a device rather than uploaded when they are needed."""
    return device.type != "cuda" or size <= DEVICE_SHARE * torch.cuda.mem_get_info(device)[0]
