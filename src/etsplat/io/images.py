"""Images on disk (8-bit PNG and JPEG) and in memory (float32, channels last, values in [0, 1])."""

import io
import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, UnidentifiedImageError, features
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.validation import check_channels_last, check_floating, check_memory
from etsplat.io.atomic import atomic_write
from etsplat.io.exif import on_its_side, turn_of
from etsplat.io.paths import given_path, kind_of

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""File name endings, lower case, that are tried when a scene names an image without one."""

MAX_PIXELS = 160_000_000
"""Larger images are refused before they are decoded: a file of a few kilobytes may unpack to gigabytes."""

IMAGE_FORMATS = ("PNG", "JPEG")
"""Pillow's names of them."""

WEBP_QUALITY = 90
"""Of lossy pictures, of 100 (docs/conventions.md has what that takes away)."""

_WEBP_SIDE = 16383

_DARKEST, _NOISE = 1.5 / 255, 0.01
"""Masks that are nowhere brighter, but not black on more than this part, have been written in other steps than those
of their format."""

_DENSEST = 520
"""Pixels of 16 bits in a byte of PNG, of which deflate makes at most 1032; JPEG needs a bit for 64 pixels at least."""


class _Bounded(io.BufferedReader):
    """A file that reads no more than it holds: what a part of a PNG claims to hold is allocated before it is read."""

    def __init__(self, file: io.FileIO) -> None:
        super().__init__(file)
        self._size = os.fstat(file.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file."""
        return super().read(size if size is None else min(size, self._size))

    def __del__(self) -> None:
        self.close()  # Pillow leaves a file open that it did not open


def open_image(path: Path | str, data: bytes | None = None, formats: tuple[str, ...] = IMAGE_FORMATS) -> Image.Image:
    """An image that is not decoded yet, of the formats that are read here and within MAX_PIXELS.

    Args:
        path: of its file.
        data: what there is of it, where it is only a part of that file.
        formats: Pillow's names of those that it may have.

    Raises:
        InputError: the file is missing, empty, too large, or not such an image.
    """
    path = given_path("path", path)
    if not path.is_file():
        raise InputError(f"image {path}: no such file; check the path")
    size = path.stat().st_size if data is None else len(data)
    if size == 0:
        raise InputError(f"image {path}: the file is empty; copy it again")
    try:
        file = _Bounded(io.FileIO(path)) if data is None else io.BytesIO(data)
    except OSError as error:
        raise InputError(f"image {path}: cannot be read ({error.strerror}); check its permissions") from error
    try:
        # Without formats Pillow tries all it knows, and starts programs.
        image = Image.open(file, formats=formats)
    except UnidentifiedImageError as error:
        raise InputError(f"image {path}: not an image that can be read; convert it to PNG or JPEG") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"image {path}: cannot be opened ({error}); convert it to PNG or JPEG") from error
    if image.width * image.height > MAX_PIXELS:
        image.close()
        raise InputError(
            f"image {path}: is {image.width}x{image.height}, more than {MAX_PIXELS // 10**6} million pixels; shrink it"
        )
    denser = 16 if image.format == "PNG" and image.mode in ("1", "L", "P") else 1  # with one bit for a pixel
    if image.format in IMAGE_FORMATS and image.width * image.height > _DENSEST * denser * size:
        image.close()
        raise InputError(
            f"image {path}: damaged or cut short (too small for {image.width}x{image.height}); copy it again"
        )
    return image


def decoded_as(image: Image.Image, path: Path | str, mode: str) -> Image.Image:
    """Decodes an image from `open_image` into a mode of Pillow's. Raises InputError if it is damaged."""
    try:
        return image.convert(mode)
    except Exception as error:  # Pillow's decoders signal damage with whatever their parsing runs into
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"image {path}: damaged or cut short ({detail}); copy it again") from error


def load_rgb(path: Path | str) -> Image.Image:
    """An image as it is shown, decoded to 8-bit RGB; what is transparent keeps its colour.

    Raises:
        InputError: as in `open_image`, or it is damaged.
    """
    with open_image(path) as image:
        return decoded_as(image, path, "RGB")


def is_transparent(path: Path | str) -> bool:
    """Whether an image is not opaque all over. Raises InputError as `load_rgb`."""
    with open_image(path) as image:
        if not (image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info):
            return False
        return bool((np.asarray(decoded_as(image, path, "RGBA"))[..., 3] < 255).any())


def load_image(path: Path | str, shape: tuple[int, int] | None = None) -> Float[Tensor, "H W C"]:
    """Read an image: straight (not premultiplied) colours.

    Args:
        path: a PNG or JPEG file. Grey becomes RGB; palettes and CMYK become RGB or RGBA.
        shape: (width, height) of its camera, which says whether poses mean the pixels as stored or turned as the
            image's EXIF says (see `size_for`); None for as stored.

    Returns:
        float32 in [0, 1], 4 channels when the file has transparency, else 3.

    Raises:
        InputError: the file is missing, empty, cut short, too large, or not an image.

    Example:
        >>> etsplat.save_image("grey.png", torch.full((2, 3, 3), 0.2))
        >>> etsplat.load_image("grey.png").shape
        torch.Size([2, 3, 3])
    """
    decoded = _decoded(given_path("path", path, "the path of an image"), shape=shape)
    if isinstance(decoded, Tensor):
        return decoded[..., None].repeat(1, 1, 3)
    return torch.from_numpy(np.array(decoded)).to(torch.float32) / 255


def load_colors(
    path: Path | str, data: bytes | None = None, formats: tuple[str, ...] = IMAGE_FORMATS
) -> tuple[np.ndarray, bool]:
    """The straight colours of an image, (H, W, 3) uint8, and whether some of it is transparent.

    Args:
        path: of its file.
        data: the image, where it is only a part of that file.
        formats: Pillow's names of those that it may have.

    Raises:
        InputError: as `load_image`.
    """
    decoded = _decoded(path, data, formats=formats)
    if isinstance(decoded, Tensor):
        return to_8_bit(decoded)[..., None].repeat(1, 1, 3).numpy(), False
    pixels = np.array(decoded)
    return np.ascontiguousarray(pixels[..., :3]), bool((pixels[..., 3:] < 255).any())


def load_pixels(path: Path | str, width: int, height: int) -> UInt8[Tensor, "H W C"]:
    """Read an image as 8-bit pixels of the given size: RGB, or premultiplied RGBA where some pixel is transparent.

    Sizes are changed with Pillow's bicubic filter, as 3DGS does. Turned as in `size_for`.

    Raises:
        InputError: as `load_image`.
    """
    loaded = _decoded(path, shape=(width, height))
    if isinstance(loaded, Tensor):
        loaded = Image.fromarray(to_8_bit(loaded).numpy()).convert("RGB")
    if loaded.mode == "RGBA":
        opaque = np.asarray(loaded)[..., 3].min() == 255
        loaded = loaded.convert("RGB" if opaque else "RGBa")
    if loaded.size != (width, height):
        loaded = loaded.resize((width, height), Image.Resampling.BICUBIC)
    pixels = np.array(loaded)
    if pixels.shape[2] == 4:  # bicubic overshoots: premultiplied colours stay below alpha
        pixels[..., :3] = np.minimum(pixels[..., :3], pixels[..., 3:])
    return torch.from_numpy(pixels)


def load_mask_pixels(path: Path | str, width: int, height: int) -> UInt8[Tensor, "H W"]:
    """Read a mask as 8-bit levels of the given size, 255 inside. Raises InputError as `load_mask`."""
    return to_8_bit(load_mask(path, (width, height)))


def load_mask(path: Path | str, size: tuple[int, int] | None = None) -> Float[Tensor, "H W"]:
    """Read a mask, 1 inside the object: the alpha channel where it varies, else the grey level.

    Args:
        path: a PNG or JPEG file.
        size: (width, height) that it is shrunk or enlarged to; None for its own.

    Returns:
        float32 in [0, 1].

    Raises:
        InputError: as `load_image`; it is nearly black all over, as with 1 for white; or it has another shape than
            `size`.
    """
    image = load_image(path)
    varies = image.shape[-1] == 4 and bool(image[..., 3].min() < 1)
    mask = image[..., 3].contiguous() if varies else image[..., :3].mean(dim=-1)
    if float(mask.max()) < _DARKEST and float((mask > 0).float().mean()) > _NOISE:
        raise InputError(
            f"mask {path}: is nearly black all over, so it may have 1 for white, or 255 in 16 bits; write 255 inside"
            " masks that have 1 there, 65535 in 16 bits"
        )
    H, W = mask.shape
    width, height = size or (W, H)
    if abs(H * width / W - height) > 2:
        raise InputError(f"mask {path}: is {W}x{H}, its image is {width}x{height}; resize the mask")
    return mask if (width, height) == (W, H) else resize_image(mask[..., None], width, height)[..., 0]


def photos_in(folder: Path) -> list[Path]:
    """The JPEG and PNG files in a folder by their names, without hidden ones."""
    files = [path for path in folder.iterdir() if kind_of(path) in IMAGE_SUFFIXES and not path.name.startswith(".")]
    return sorted(files, key=lambda path: path.name)


def image_size(path: Path | str) -> tuple[int, int]:
    """(width, height) of an image file, from its header alone. Raises InputError as `load_image`."""
    with open_image(path) as image:
        return image.size


def size_for(path: Path | str, shape: tuple[float, float]) -> tuple[int, int]:
    """(width, height) of an image file whose camera has the shape `shape`.

    Poses mean the pixels as whoever found them read them: COLMAP as stored, others turned as EXIF says. Which of the
    two is seen from the shape: an image that lies on its side is turned where its camera does not.

    Raises:
        InputError: as `load_image`.
    """
    with open_image(path) as image:
        return (image.height, image.width) if _is_to_turn(image, shape) else image.size


def save_image(path: Path | str, image: Float[Tensor, "H W C"]) -> None:
    """Write an image, rounded to 8 bits; the suffix of `path` chooses the format. Atomic.

    Args:
        path: ends in .png, .jpg or .jpeg.
        image: 1, 3 or 4 channels (straight alpha; JPEG has none), values in [0, 1] (others are clamped).

    Raises:
        ValueError: wrong shape, whole numbers, or values that are not finite.
        InputError: the file cannot be written.

    Example:
        >>> etsplat.save_image("grey.png", torch.full((4, 6, 3), 0.5))
        >>> etsplat.load_image("grey.png").shape
        torch.Size([4, 6, 3])
    """
    path = given_path("path", path)
    channels = (1, 3) if kind_of(path) in (".jpg", ".jpeg") else (1, 3, 4)
    if kind_of(path) not in IMAGE_SUFFIXES:
        raise ValueError(f"path: expected one of the suffixes {', '.join(IMAGE_SUFFIXES)}, got {path.name}")
    check_memory("image", image)
    check_floating("image", image)
    if image.ndim == 3 and image.numel():
        check_channels_last("image", image)
    if image.ndim != 3 or image.shape[-1] not in channels:
        raise ValueError(f"image: expected shape (H, W, C) with C in {channels}, got {tuple(image.shape)}")
    pixels = Image.fromarray(to_8_bit(image).cpu().numpy().squeeze(axis=-1 if image.shape[-1] == 1 else ()))
    # Encoded in memory first: Pillow's JPEG encoder does not notice when a full disk takes only a part.
    encoded = io.BytesIO()
    kind = "PNG" if kind_of(path) == ".png" else "JPEG"
    pixels.save(encoded, format=kind, quality=95, subsampling=0)  # PNG ignores the last two
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.getvalue())


def encode_png(pixels: np.ndarray) -> bytes:
    """A PNG file of uint8, (H, W, 3), or (H, W) for grey."""
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, format="PNG")
    return encoded.getvalue()


def encode_webp(pixels: np.ndarray, *, lossy: bool) -> bytes:
    """A WebP file of uint8, (H, W, 3), or (H, W) for grey; lossy at `WEBP_QUALITY`.

    Raises:
        InputError: this Pillow writes no WebP, or no such file is so large.
    """
    if not features.check("webp"):
        raise InputError("this Pillow was built without WebP; install one from PyPI, or take pictures in PNG")
    if max(pixels.shape[:2]) > _WEBP_SIDE:
        raise InputError(f"WebP has at most {_WEBP_SIDE} pixels along a side; take pictures in PNG")
    encoded = io.BytesIO()
    image = Image.fromarray(pixels).convert("RGB")
    image.save(encoded, format="WEBP", lossless=not lossy, quality=WEBP_QUALITY if lossy else 100, method=4)
    return encoded.getvalue()


def to_8_bit(image: Float[Tensor, "..."]) -> UInt8[Tensor, "..."]:
    """Round values in [0, 1] (others are clamped) to uint8, half up. Raises ValueError for NaN and Inf."""
    if not bool(torch.isfinite(image).all()):
        raise ValueError("image: expected finite values, got NaN or Inf")
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def premultiply(image: Float[Tensor, "*B H W C"]) -> Float[Tensor, "*B H W 4"]:
    """Straight RGB or RGBA to premultiplied RGBA; RGB counts as fully opaque."""
    if image.shape[-1] == 3:
        return torch.cat([image, torch.ones_like(image[..., :1])], dim=-1)
    alpha = image[..., 3:]
    return torch.cat([image[..., :3] * alpha, alpha], dim=-1)


def over_background(
    image: Float[Tensor, "*B H W 4"], background: Float[Tensor, "#*B #H #W 3"] | float
) -> Float[Tensor, "*B H W 3"]:
    """Premultiplied RGBA over a background: rgb + (1 - alpha) background."""
    return image[..., :3] + (1 - image[..., 3:]) * background


def resize_image(image: Float[Tensor, "H W C"], width: int, height: int) -> Float[Tensor, "H2 W2 C"]:
    """Shrink or enlarge with a triangle filter as wide as the scale; no ringing. Premultiply RGBA first."""
    planes = image.movedim(-1, 0)[None]
    resized = torch.nn.functional.interpolate(planes, size=(height, width), mode="bilinear", antialias=True)
    return resized[0].movedim(0, -1).clamp(0, 1).contiguous()


def _is_to_turn(image: Image.Image, shape: tuple[float, float]) -> bool:
    return (image.width - image.height) * (shape[0] - shape[1]) < 0 and on_its_side(image)


def _decoded(
    path: Path | str,
    data: bytes | None = None,
    shape: tuple[int, int] | None = None,
    formats: tuple[str, ...] = IMAGE_FORMATS,
) -> Image.Image | Float[Tensor, "H W"]:
    """8-bit RGB, or RGBA with transparency; or levels of 16-bit grey, which Pillow would clip instead of scale."""
    with open_image(path, data, formats) as image:
        turn = turn_of(image) if shape is not None and _is_to_turn(image, shape) else None
        deep = image.mode.startswith("I")
        transparent = image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
        decoded = decoded_as(image, path, image.mode if deep else "RGBA" if transparent else "RGB")
    decoded = decoded if turn is None else decoded.transpose(turn)
    if not deep:
        return decoded
    return torch.from_numpy(np.asarray(decoded).astype(np.float32) / 65535.0).clamp(0, 1)
