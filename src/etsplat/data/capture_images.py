"""The images of a capture, as bytes: decoded in parallel, all kept where they fit into memory, streamed where not."""

import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import UInt8
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame
from etsplat.io.images import load_mask_pixels, load_pixels
from etsplat.io.paths import kind_of

_SAMPLE = 4096
"""So many bytes of each file's beginning, middle and end, with its length, tell it from others."""


@dataclass(frozen=True)
class Picture:
    """One decoded image.

    Attributes:
        pixels: (H, W, 3), or (H, W, 4) premultiplied where the source is transparent.
        mask: (H, W), 255 where pixels count and 0 where they are to be ignored; None if all count.
    """

    pixels: UInt8[Tensor, "H W C"]
    mask: UInt8[Tensor, "H W"] | None


class CaptureImages:
    """A read-only sequence of 8-bit images, indexed by view; `sizes` are their (width, height).

    Within `limit` bytes everything stays decoded. Beyond it the images used last are kept, and `expect` decodes those
    that are needed next while the caller works. Safe to use from several threads.
    """

    def __init__(self, frames: Sequence[Frame], sizes: Sequence[tuple[int, int]], limit: int) -> None:
        self.sizes = list(sizes)
        self._frames = list(frames)
        self._limit = limit
        self._bytes = [_size_in_bytes(frame, size) for frame, size in zip(frames, sizes, strict=True)]
        self.total_bytes = sum(self._bytes)
        self._kept: OrderedDict[int, Future[Picture]] = OrderedDict()
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, 8), thread_name_prefix="images")

    @property
    def streamed(self) -> bool:
        """Whether the set is larger than the limit."""
        return self.total_bytes > self._limit

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> UInt8[Tensor, "H W C"]:
        """(H, W, 3), or (H, W, 4) premultiplied where the source is transparent.

        Raises:
            IndexError: no such view.
            InputError: the file is damaged or has gone.
        """
        return self._picture(index).pixels

    def __iter__(self) -> Iterator[UInt8[Tensor, "H W C"]]:
        return (self[index] for index in range(len(self)))

    def mask(self, index: int) -> UInt8[Tensor, "H W"] | None:
        """(H, W), 255 where pixels of the view count and 0 where they are to be ignored; None if all count."""
        return self._picture(index).mask

    def fingerprint(self) -> bytes:
        """What the files hold, not when they were written: the same for a copy. Decodes nothing.

        Raises:
            InputError: a file has gone.
        """
        digest = hashlib.sha256()
        files = [file for frame in self._frames for file in (frame.image, frame.mask) if file is not None]
        for sample in self._pool.map(_sample, files):
            digest.update(sample)
        return digest.digest()

    def expect(self, indices: Sequence[int]) -> None:
        """Start to decode views that are needed soon, as many as fit."""
        space = self._limit
        for index in indices:
            space -= self._bytes[index]
            if space < 0:
                break
            self._future(index)

    def preload(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Decode everything once, so that damaged files are found now, and keep it, if it fits.

        Args:
            progress: called with (images decoded, images in all).

        Raises:
            InputError: a file is damaged.
        """
        futures = [self._check(index) if self.streamed else self._future(index) for index in range(len(self))]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                if progress is not None:
                    progress(done, len(futures))
        finally:
            for future in futures:
                future.cancel()

    def _check(self, index: int) -> Future[None]:
        def decode() -> None:
            _decode(self._frames[index], self.sizes[index])

        return self._pool.submit(decode)

    def _picture(self, index: int) -> Picture:
        if not 0 <= index < len(self):
            raise IndexError(f"view {index}: expected one in [0, {len(self)})")
        try:
            return self._future(index).result()
        except BaseException:
            with self._lock:
                self._kept.pop(index, None)
            raise

    def _future(self, index: int) -> Future[Picture]:
        with self._lock:
            if index not in self._kept:
                self._kept[index] = self._pool.submit(_decode, self._frames[index], self.sizes[index])
            self._kept.move_to_end(index)
            used = sum(self._bytes[kept] for kept in self._kept) if self.streamed else 0
            while used > self._limit and len(self._kept) > 1:
                used -= self._bytes[next(iter(self._kept))]
                self._kept.popitem(last=False)
            return self._kept[index]


class StoredImages:
    """Images that are in memory already, with the interface of `CaptureImages`."""

    streamed = False

    def __init__(self, pixels: Sequence[UInt8[Tensor, "H W C"]]) -> None:
        self._pixels = list(pixels)
        self.sizes = [(image.shape[1], image.shape[0]) for image in self._pixels]
        self.total_bytes = sum(image.numel() for image in self._pixels)

    def __len__(self) -> int:
        return len(self._pixels)

    def __getitem__(self, index: int) -> UInt8[Tensor, "H W C"]:
        """(H, W, 3), or (H, W, 4) premultiplied."""
        return self._pixels[index]

    def __iter__(self) -> Iterator[UInt8[Tensor, "H W C"]]:
        return iter(self._pixels)

    def mask(self, index: int) -> None:
        """All pixels count."""

    def fingerprint(self) -> bytes:
        """Of all pixels."""
        digest = hashlib.sha256()
        for image in self._pixels:
            digest.update(image.contiguous().numpy().tobytes())
        return digest.digest()

    def expect(self, indices: Sequence[int]) -> None:
        """Nothing to prepare."""


def _size_in_bytes(frame: Frame, size: tuple[int, int]) -> int:
    """An upper bound: PNG files may turn out to have no transparency."""
    channels = (4 if kind_of(frame.image) == ".png" else 3) + (frame.mask is not None)
    return size[0] * size[1] * channels


def _decode(frame: Frame, size: tuple[int, int]) -> Picture:
    pixels = load_pixels(frame.image, *size)
    if frame.mask is None:
        return Picture(pixels, None)
    return Picture(pixels, load_mask_pixels(frame.mask, *size))


def _sample(path: Path) -> bytes:
    """A hash of a file's length and of three parts of it."""
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            digest.update(size.to_bytes(8, "little"))
            for start in (0, size // 2, max(0, size - _SAMPLE)):
                file.seek(start)
                digest.update(file.read(_SAMPLE))
    except OSError as error:
        raise InputError(f"image {path}: cannot be read ({error.strerror}); copy it there again") from error
    return digest.digest()
