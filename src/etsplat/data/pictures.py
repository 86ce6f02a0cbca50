"""The photos of a data set: made in parallel when they are needed, and kept in memory as far as they fit there."""

import hashlib
import os
import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from etsplat.core.cameras import check_size
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import shown, whole_number
from etsplat.core.workers import workers
from etsplat.data.dataset_checks import as_many, checked_mask, checked_pixels, is_straight
from etsplat.io.memory import available_memory

Pixels = UInt8[Tensor, "H W C"] | Float[Tensor, "H W 4"]
"""Bytes of 3 channels, or of 4 premultiplied; or premultiplied RGBA in [0, 1]."""


def as_float(pixels: Pixels) -> Float[Tensor, "H W C"]:
    """Pixels in [0, 1]."""
    return pixels.float() / 255 if pixels.dtype == torch.uint8 else pixels


def unpremultiplied(pixels: Float[Tensor, "*N C"]) -> tuple[Float[Tensor, "*N 3"], Bool[Tensor, "*N"]]:
    """Colours of pixels in [0, 1] as they are where nothing shines through, and which are more than half opaque."""
    if pixels.shape[-1] == 3:
        return pixels, torch.ones(pixels.shape[:-1], dtype=torch.bool)
    return pixels[..., :3] / pixels[..., 3:].clamp_min(1e-3), pixels[..., 3] > 0.5


@dataclass(frozen=True, eq=False)
class Picture:
    """One photo.

    Attributes:
        pixels: bytes of 3 channels, or of 4 premultiplied; or premultiplied RGBA in [0, 1].
        mask: (H, W), 255 where pixels count and 0 where they are to be ignored; None if all count.
        depth: (H, W) distances along the optical axis, in the units of the capture's files whatever frame the data set
            is in; 0 where they are not known. None without.

    Example:
        >>> grey = torch.full((48, 64, 3), 128, dtype=torch.uint8)
        >>> etsplat.Picture(grey, mask=torch.full((48, 64), 255, dtype=torch.uint8)).depth is None
        True
    """

    __repr__ = short_repr

    pixels: Pixels
    mask: UInt8[Tensor, "H W"] | None = None
    depth: Float[Tensor, "H W"] | None = None


class Pictures(ABC):
    """Photos by view.

    Attributes:
        sizes: (width, height) of each.
        total_bytes: what all of them take in memory.
        streamed: whether they do not fit into memory, so that each is made anew when it is needed.
        with_depth: the views whose photos have depth maps.
        straight: the views whose colours are above their alpha though they are to be premultiplied; of photos that are
            in memory already.
    """

    sizes: list[tuple[int, int]]
    total_bytes: int
    streamed: bool = False
    with_depth: frozenset[int] = frozenset()
    straight: tuple[int, ...] = ()

    @property
    @abstractmethod
    def held_bytes(self) -> int:
        """What those that are in memory now take."""

    @abstractmethod
    def picture(self, index: int) -> Picture:
        """Raises IndexError where there is no such view, InputError where its file is damaged or has gone."""

    @abstractmethod
    def fingerprint(self) -> bytes:
        """A hash of what they show; the same for a copy."""

    @abstractmethod
    def subset(self, indices: Sequence[int]) -> "Pictures":
        """Some of them, in this order, which are kept and let go of apart from these."""

    def expect(self, indices: Sequence[int]) -> None:  # noqa: B027 -- a wish, which a subclass may leave
        """Start to make those that are needed soon, as many as fit."""

    def __len__(self) -> int:
        """How many."""
        return len(self.sizes)

    def __getitem__(self, index: int) -> Pixels:
        """Pixels of one photo; of several there is `subset`.

        Raises:
            IndexError: the index is none of a photo; and what `picture` raises.
        """
        one = whole_number(index)
        if one is None:
            raise IndexError(
                f"index of a photo must be a whole number, got {shown(index)}: subset(indices) has several"
            )
        return self.picture(one + len(self) if one < 0 else one).pixels

    def __repr__(self) -> str:
        """How many, in which sizes."""
        sizes = sorted({f"{width}x{height}" for width, height in self.sizes})
        return f"{type(self).__name__}({len(self)} of {', '.join(sizes[:3])}{', ...' if len(sizes) > 3 else ''})"

    def __iter__(self) -> Iterator[Pixels]:
        return (self[index] for index in range(len(self.sizes)))

    def mask(self, index: int) -> UInt8[Tensor, "H W"] | None:
        """(H, W), 255 where pixels of the view count and 0 where they are to be ignored; None if all count."""
        return self.picture(index).mask

    def depth(self, index: int) -> Float[Tensor, "H W"] | None:
        """(H, W), as of `Picture`; None if the view has no depth map."""
        return self.picture(index).depth


class StoredPictures(Pictures):
    """Photos that are in memory already.

    Example:
        >>> pictures = etsplat.StoredPictures([torch.zeros(48, 64, 3, dtype=torch.uint8)])
        >>> pictures[0].shape
        torch.Size([48, 64, 3])
    """

    def __init__(
        self,
        pixels: Sequence[Pixels],
        masks: Sequence[Tensor | None] | None = None,
        depths: Sequence[Float[Tensor, "H W"] | None] | None = None,
    ) -> None:
        """Takes them, with masks and depth maps of some or all.

        Args:
            pixels: (H, W, 3) bytes, or (H, W, 4) premultiplied, or float32 in [0, 1]. Alpha says what belongs to an
                object; where it is below 1 a background shows.
            masks: (H, W) of booleans, of floats in [0, 1], or of bytes with 255 where pixels count. Others are ignored:
                a mask says nothing of an object, which has alpha.
            depths: (H, W), as of `Picture`.

        Raises:
            ValueError: a photo, mask or depth map of another shape or kind.
        """
        pixels = [checked_pixels(f"pixels[{index}]", image) for index, image in enumerate(pixels)]
        masks = [
            None if mask is None else checked_mask(f"masks[{index}]", mask, image)
            for index, (mask, image) in enumerate(zip(as_many("masks", masks, len(pixels)), pixels, strict=True))
        ]
        maps = as_many("depths", depths, len(pixels))
        self._pictures = [Picture(*each) for each in zip(pixels, masks, maps, strict=True)]
        for index, (image, depth) in enumerate(zip(pixels, maps, strict=True)):
            if depth is not None and depth.shape != image.shape[:2]:
                raise ValueError(f"depths[{index}]: expected {tuple(image.shape[:2])}, got {tuple(depth.shape)}")
        self.with_depth = frozenset(index for index, depth in enumerate(maps) if depth is not None)
        self.straight = tuple(index for index, image in enumerate(pixels) if is_straight(image))
        self._tensors = [*pixels, *masks, *(maps if self.with_depth else [])]
        self.sizes = [(image.shape[1], image.shape[0]) for image in pixels]
        self.total_bytes = sum(image.numel() * image.element_size() for image in self._tensors if image is not None)

    @property
    def held_bytes(self) -> int:
        """All."""
        return self.total_bytes

    def picture(self, index: int) -> Picture:
        """As handed in."""
        return self._pictures[index]

    def subset(self, indices: Sequence[int]) -> "StoredPictures":
        """The same tensors."""
        some = [self._pictures[index] for index in indices]
        return StoredPictures([one.pixels for one in some], [one.mask for one in some], [one.depth for one in some])

    def fingerprint(self) -> bytes:
        """Of all pixels, masks and depth maps."""
        return _digest(self._tensors)


class LazyPictures(Pictures):
    """Photos that are made when they are first asked for. Safe to use from several threads.

    Within `limit` bytes everything stays. Beyond it the photos used last are kept, and `expect` makes those that are
    needed next while the caller works.

    Example:
        Photos of a simulator, as a run needs them:

        >>> cameras = etsplat.orbit_cameras(16, 12, elevations=(20.0,), azimuths=8)
        >>> vertices, faces = etsplat.icosphere(2)
        >>> def shoot(view):
        ...     colors = torch.linspace(0, 1, len(faces))[:, None].expand(-1, 3)
        ...     return etsplat.render_opaque(vertices, faces=faces, face_colors=colors, cameras=cameras[view]).rgba[0]
        >>> photos = etsplat.LazyPictures(shoot, [(16, 12)] * 8)
        >>> photos.held_bytes, photos[3].shape
        (0, torch.Size([12, 16, 4]))
    """

    def __init__(
        self,
        make: Callable[[int], Picture | Pixels],
        sizes: Sequence[tuple[int, int]],
        sizes_in_bytes: Sequence[int] | None = None,
        fingerprint: Callable[[], bytes] | None = None,
        limit: int | None = None,
        with_depth: Collection[int] = (),
    ) -> None:
        """Makes nothing yet.

        Args:
            make: the photo of a view, or its pixels alone as `StoredPictures` takes them; the same at each call, which
                come from other threads.
            sizes: (width, height) of each.
            sizes_in_bytes: upper bounds; None for those of floats with alpha, a mask and depths.
            fingerprint: of all of them, without making any; None makes all of them for it, where a run is kept.
            limit: bytes that may be kept; None for half of the memory that is free, shared with other workers.
            with_depth: the views whose photos have depth maps.

        Raises:
            ValueError: a size is none of an image; and later, where they are made, photos of another size or kind.
        """
        self.with_depth = frozenset(with_depth)
        self.sizes = [check_size(width, height) for width, height in sizes]
        self._bytes = [21 * width * height for width, height in self.sizes]
        if sizes_in_bytes is not None:
            self._bytes = list(as_many("sizes_in_bytes", sizes_in_bytes, len(self.sizes)))
        self.total_bytes = sum(self._bytes)
        self._given, self._fingerprint = make, fingerprint
        self._limit = available_memory() // 2 // workers().neighbours if limit is None else limit
        self.streamed = self.total_bytes > self._limit
        self._begin()

    def _begin(self) -> None:
        """With threads of this process, and no photo."""
        self._kept: OrderedDict[int, Future[Picture]] = OrderedDict()
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, 8), thread_name_prefix="images")
        self._process = os.getpid()

    def _here(self) -> None:
        """In a process that was forked, as workers of a DataLoader are, the threads are gone, and locks may be held."""
        if self._process != os.getpid():
            self._begin()

    def __getstate__(self) -> dict[str, Any]:
        """For copies and other processes, which make their photos themselves."""
        return {name: value for name, value in vars(self).items() if name not in _AT_WORK}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """As handed over by `__getstate__`."""
        vars(self).update(state)
        self._begin()

    def _make(self, index: int) -> Picture:
        """As it is given, once it has been looked at."""
        found, name = self._given(index), f"make({index})"
        picture = found if isinstance(found, Picture) else Picture(found)
        pixels, (width, height) = checked_pixels(name, picture.pixels), self.sizes[index]
        if tuple(pixels.shape[:2]) != (height, width):
            got = tuple(pixels.shape)
            raise ValueError(f"{name} must have {width} x {height} pixels, as `sizes` says, got shape {got}")
        picture = replace(picture, pixels=pixels)
        if picture.mask is None or picture.mask.dtype == torch.uint8:  # bytes as files have them need no look
            return picture
        return replace(picture, mask=checked_mask(f"the mask of {name}", picture.mask, pixels))

    @property
    def held_bytes(self) -> int:
        """Of those that were made, or are being made, and are kept."""
        self._here()
        with self._lock:
            return sum(self._bytes[kept] for kept in self._kept)

    def picture(self, index: int) -> Picture:
        """Raises IndexError where there is no such view, and what making it raises."""
        self._here()
        if not 0 <= index < len(self.sizes):
            raise IndexError(f"view {index}: expected one in [0, {len(self.sizes)})")
        try:
            return self._future(index).result()
        except BaseException:
            with self._lock:
                self._kept.pop(index, None)
            raise

    def subset(self, indices: Sequence[int]) -> "LazyPictures":
        """Made anew, and kept where they fit into what is free now."""
        chosen = list(indices)
        return LazyPictures(
            partial(_chosen, self._given, chosen),
            [self.sizes[index] for index in chosen],
            [self._bytes[index] for index in chosen],
            partial(_name_of_chosen, self, chosen),
            with_depth=[place for place, index in enumerate(chosen) if index in self.with_depth],
        )

    def fingerprint(self) -> bytes:
        """Made by what it was constructed with, or of all pixels, masks and depth maps."""
        if self._fingerprint is not None:
            return self._fingerprint()
        pictures = map(self.picture, range(len(self.sizes)))
        return _digest(tensor for one in pictures for tensor in (one.pixels, one.mask, one.depth))

    def expect(self, indices: Sequence[int]) -> None:
        """Start to make those that are needed soon, as many as fit."""
        self._here()
        space = self._limit
        for index in indices:
            space -= self._bytes[index]
            if space < 0:
                break
            self._future(index)

    def preload(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Make everything once, so that damaged files are found now, and keep it, if it fits.

        Of several workers each makes those that are its own (`optim.shared_steps.owners`).

        Args:
            progress: called with (photos made, photos in all).

        Raises:
            InputError: a file is damaged.
        """
        self._here()
        group = workers()
        views = range(group.rank, len(self.sizes), group.count)
        futures = [self._pool.submit(self._check, view) if self.streamed else self._future(view) for view in views]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                if progress is not None:
                    progress(done, len(futures))
        finally:
            for future in futures:
                future.cancel()

    def _check(self, index: int) -> None:
        self._make(index)  # and forgets it

    def _future(self, index: int) -> Future[Picture]:
        with self._lock:
            if index not in self._kept:
                self._kept[index] = self._pool.submit(self._make, index)
            self._kept.move_to_end(index)
            used = sum(self._bytes[kept] for kept in self._kept) if self.streamed else 0
            while used > self._limit and len(self._kept) > 1:
                used -= self._bytes[next(iter(self._kept))]
                self._kept.popitem(last=False)
            return self._kept[index]


_AT_WORK = ("_kept", "_lock", "_pool", "_process")
"""Attributes of `LazyPictures` that belong to one process."""


def _chosen(make: Callable[[int], Picture | Pixels], chosen: Sequence[int], index: int) -> Picture | Pixels:
    return make(chosen[index])


def _name_of_chosen(pictures: Pictures, chosen: list[int]) -> bytes:
    return hashlib.sha256(pictures.fingerprint() + repr(chosen).encode()).digest()


def _digest(tensors: Iterable[Tensor | None]) -> bytes:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(b"none" if tensor is None else tensor.contiguous().cpu().numpy().data)
    return digest.digest()
