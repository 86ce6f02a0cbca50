"""How alike two images are: PSNR, SSIM in both conventions, LPIPS (VGG) in both conventions.

All take float images (H, W, 3) with values in [0, 1] and no transparency; ours are composited over black first.
Numbers of different papers are comparable only in the same convention, so every function says which it is.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn

from etsplat.core.errors import InputError
from etsplat.core.spelling import either
from etsplat.core.validation import check_channels_last, check_device, check_floating, check_memory
from etsplat.engines.threads import all_torch_threads, one_torch_thread
from etsplat.io.paths import kind_of
from etsplat.io.tensors import read_state_dict

_BRIGHT = 2.0
"""No photo of values in [0, 1] is so bright in the mean."""

_C1, _C2 = 0.01**2, 0.03**2
WINDOW, _SIGMA = 11, 1.5

_VGG16 = (64, 64, "pool", 128, 128, "pool", 256, 256, 256, "pool", 512, 512, 512, "pool", 512, 512, 512)
_TAPS = (3, 8, 15, 22, 29)
"""Layers of torchvision's vgg16.features whose output LPIPS compares: relu1_2, 2_2, 3_3, 4_3, 5_3."""

_WEIGHTS = {
    "vgg16-397923af.pth": (
        "https://download.pytorch.org/models/vgg16-397923af.pth",
        "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    ),
    "vgg.pth": (
        "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/vgg.pth",
        "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
}
"""Where the weights of LPIPS come from, by the names that torch's cache has for them; SHA-256 of each."""


@one_torch_thread()
@torch.no_grad()
def psnr(image: Float[Tensor, "H W C"], truth: Float[Tensor, "H W C"]) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 mean((image - truth)^2), peak 1, in float (no rounding to 8 bits).

    Infinite for equal images. For several views the field takes the mean of their PSNRs.

    Raises:
        ValueError: shapes differ or are not (H, W, C), there are no pixels, or no floating-point numbers.

    Example:
        >>> truth = torch.zeros(8, 8, 3)
        >>> round(etsplat.psnr(truth + 0.1, truth), 2)
        20.0
    """
    _check_pair(image, truth)
    error = float(((image.double() - truth.double()) ** 2).mean())
    return math.inf if error == 0 else -10 * math.log10(error)


@one_torch_thread()
def colors_fitted(
    image: Float[Tensor, "H W 3"],
    truth: Float[Tensor, "H W 3"],
    *,
    counts: Float[Tensor, "H W"] | None = None,
    coverage: Float[Tensor, "H W"] | None = None,
    background: Float[Tensor, "3"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """An image with its colours mapped to M c + t, with the M (3, 3) and t (3,) that bring it closest to another.

    By least squares over all pixels, in float64; the result is in [0, 1]. For what a camera's exposure and white
    balance hide: a score of the result has seen the truth, and is none of the image.

    Args:
        image: over the background.
        truth: over the background.
        counts: (H, W) weights of the pixels; None for 1.
        coverage: (H, W) opacity of what is mapped: the background shows through and stays. None for all of the image.
        background: (3,); None for black.

    Raises:
        ValueError: shapes differ or are not (H, W, 3).
    """
    _check_pair(image, truth)
    x, y = image.double(), truth.double()
    whole = torch.ones_like(x[..., :1])
    weight = whole if counts is None else counts[..., None].to(x)
    alpha = whole if coverage is None else coverage[..., None].to(x)
    behind = torch.zeros_like(x) if background is None else (1 - alpha) * background.to(x)
    basis = torch.cat([x - behind, alpha], dim=-1).flatten(0, 1)
    weighted = (weight * basis.view(*x.shape[:2], 4)).flatten(0, 1)
    squares, products = weighted.T @ basis, weighted.T @ (y - behind).flatten(0, 1)
    if not bool(squares.isfinite().all()):
        return image
    mapped = (basis @ (torch.linalg.pinv(squares, hermitian=True) @ products)).view_as(x)
    return (mapped + behind).clamp(0.0, 1.0).to(image)


def silhouette_iou(coverage: Float[Tensor, "H W"], truth: Float[Tensor, "H W"]) -> float:
    """Intersection over union of two silhouettes: pixels that are covered by at least half. 1 where both are empty.

    Raises:
        ValueError: shapes or devices differ; bytes, of which half is no 0.5.

    Example:
        >>> left, all_of_it = torch.zeros(4, 4), torch.ones(4, 4)
        >>> left[:, :2] = 1
        >>> etsplat.silhouette_iou(left, all_of_it)
        0.5
    """
    check_memory("coverage", coverage)
    check_memory("truth", truth)
    check_device("truth", truth, "coverage", coverage)
    if truth.shape != coverage.shape:
        raise ValueError(f"truth must have the coverage's shape {tuple(coverage.shape)}, got {tuple(truth.shape)}")
    for name, given in (("coverage", coverage), ("truth", truth)):
        if not (given.is_floating_point() or given.dtype == torch.bool):
            raise ValueError(f"{name} must be floats in [0, 1] or booleans, got {given.dtype}")
    ours, theirs = coverage >= 0.5, truth >= 0.5
    union = int((ours | theirs).sum())
    return int((ours & theirs).sum()) / union if union else 1.0


@one_torch_thread()
@torch.no_grad()
def ssim(image: Float[Tensor, "H W C"], truth: Float[Tensor, "H W C"], *, interior: bool = False) -> float:
    """Structural similarity (Wang et al. 2004): 11x11 Gaussian window of sigma 1.5, C1 = 0.01^2, C2 = 0.03^2, peak 1.

    Per channel, mean over channels and pixels, in float64.

    Args:
        image: values in [0, 1].
        truth: values in [0, 1].
        interior: False as 3DGS and its followers: zeros beyond the border, mean over the whole image. True as
            torchmetrics (gsplat): the mean over the pixels whose window lies inside the image.

    Raises:
        ValueError: shapes differ or are not (H, W, C); with `interior`, an image smaller than the window.

    Example:
        >>> picture = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
        >>> round(etsplat.ssim(picture, picture), 6)
        1.0
    """
    _check_pair(image, truth)
    if interior and min(image.shape[:2]) < WINDOW:
        raise ValueError(f"image: expected at least {WINDOW} pixels a side for the interior SSIM, got {image.shape}")
    x, y = image.double().movedim(-1, 0), truth.double().movedim(-1, 0)
    moments = _blur(torch.stack([x, y, x * x, y * y, x * y]), 0 if interior else WINDOW // 2)
    mean_x, mean_y, square_x, square_y, product = moments
    variance_x, variance_y = square_x - mean_x**2, square_y - mean_y**2
    covariance = product - mean_x * mean_y
    similarity = ((2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)) / (
        (mean_x**2 + mean_y**2 + _C1) * (variance_x + variance_y + _C2)
    )
    return float(similarity.mean())


class Lpips(nn.Module):
    """LPIPS v0.1 with the VGG16 trunk (Zhang et al. 2018): a weighted distance between deep features.

    At five layers l of VGG16 the features of both images are scaled to unit length at every pixel, subtracted, squared,
    weighted per channel by w_l >= 0 and averaged over pixels; LPIPS is the sum over the layers:
    ``sum_l mean_hw sum_c w_lc (f_lc(a) / |f_l(a)| - f_lc(b) / |f_l(b)|)^2``.

    The state dict has exactly these entries (float32), which are torchvision's and LPIPS's own names:
    `features.{0,2,5,7,10,12,14,17,19,21,24,26,28}.{weight,bias}` (3x3 convolutions of torchvision's vgg16 with weights
    IMAGENET1K_V1) and `lin{0..4}.model.1.weight`, (1, C, 1, 1) with C = 64, 128, 256, 512, 512 (LPIPS v0.1's vgg.pth).

    Example:
        >>> entries = etsplat.Lpips().state_dict()  # Lpips.from_weights("lpips_vgg16.pth") has what was learned
        >>> len(entries), entries["lin4.model.1.weight"].shape
        (31, torch.Size([1, 512, 1, 1]))
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for width in _VGG16:
            if isinstance(width, str):
                layers.append(nn.MaxPool2d(2))
            else:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
        self.features = nn.Sequential(*layers)
        for index, width in enumerate((64, 128, 256, 512, 512)):
            # The first entry stands where LPIPS has a dropout, so that the names agree.
            linear = nn.ModuleDict({"model": nn.Sequential(nn.Identity(), nn.Conv2d(width, 1, 1, bias=False))})
            self.add_module(f"lin{index}", linear)
        self.requires_grad_(False)
        self._learned = False

    def _load_from_state_dict(self, *arguments: Any, **named: Any) -> None:
        super()._load_from_state_dict(*arguments, **named)
        self._learned = True

    @staticmethod
    def from_weights(*paths: Path | str) -> "Lpips":
        """The metric with weights from one or more files that hold all entries together (others are ignored).

        One file for `--lpips-weights` is made from the two usual ones by
        `torch.save(torch.load("vgg16-397923af.pth") | torch.load("vgg.pth"), "lpips_vgg16.pth")`.

        Args:
            paths: `.safetensors`, or `.pth`/`.pt` state dicts (read without running code from the file).

        Raises:
            InputError: a file is missing or unreadable, an entry is missing or has another shape.
        """
        entries: dict[str, Tensor] = {}
        for path in paths:
            entries |= _read_weights(Path(path))
        names = ", ".join(str(path) for path in paths)
        lpips = Lpips()
        expected = lpips.state_dict()
        missing = [key for key in expected if key not in entries]
        if missing:
            raise InputError(
                f"LPIPS weights {names}: {len(missing)} entries are missing (first: {missing[0]}); the file must hold"
                " torchvision's vgg16 and LPIPS's v0.1 linear weights together"
            )
        for key, value in expected.items():
            if entries[key].shape != value.shape:
                shapes = f"{tuple(entries[key].shape)} instead of {tuple(value.shape)}"
                raise InputError(f"LPIPS weights {names}: {key} has shape {shapes}; use the VGG16 weights of v0.1")
        lpips.load_state_dict({key: entries[key].float() for key in expected})
        return lpips

    @torch.no_grad()
    @one_torch_thread()
    def forward(self, image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], *, rescale: bool = True) -> Tensor:
        """The distance, a scalar tensor; 0 for equal images.

        Args:
            image: values in [0, 1].
            truth: values in [0, 1].
            rescale: True maps [0, 1] to [-1, 1], the range that the network's input normalisation was made for
                (lpips package, torchmetrics with normalize=True). False feeds [0, 1] as it is, the convention of 3DGS,
                2DGS and Triangle Splatting ("lpips_3dgs"); its values are not comparable with the former.

        Raises:
            ValueError: shapes differ, are not (H, W, 3), or are below 16 pixels a side; no weights were loaded, and
                those at random say nothing.
        """
        if not self._learned:
            raise ValueError("Lpips has no weights: take Lpips.from_weights(FILE), or load_state_dict what was learned")
        _check_pair(image, truth)
        if image.shape[-1] != 3 or min(image.shape[:2]) < 16:
            raise ValueError(f"image: expected shape (H, W, 3) of at least 16 pixels a side, got {tuple(image.shape)}")
        pair = torch.stack([image, truth]).to(next(self.parameters())).movedim(-1, 1)
        pair = 2 * pair - 1 if rescale else pair
        shift = pair.new_tensor([-0.030, -0.088, -0.188]).view(3, 1, 1)
        scale = pair.new_tensor([0.458, 0.448, 0.450]).view(3, 1, 1)
        features, total = (pair - shift) / scale, pair.new_zeros(())
        for index, layer in enumerate(self.features):
            with all_torch_threads():
                features = layer(features)
            if index in _TAPS:
                unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
                weigh = self.get_submodule(f"lin{_TAPS.index(index)}.model")
                total = total + weigh((unit[:1] - unit[1:]).square()).mean()
        return total


@dataclass(frozen=True)
class LpipsWeights:
    """Where the weights are.

    Attributes:
        paths: files for `Lpips.from_weights`, none if there are no weights.
        reason: why there are none, in a sentence; None if there are.
    """

    paths: tuple[Path, ...]
    reason: str | None


def find_lpips_weights(option: Path | str | None = None) -> LpipsWeights:
    """Resolve the option `--lpips-weights`, or the setting `output.lpips_weights`.

    Args:
        option: a file; the word "download", which fetches the two usual files (torchvision's VGG16, 528 MB, and LPIPS's
            linear weights) into torch's cache unless they are there to the bit; or None, which uses them if they are
            there and never touches the network.

    Raises:
        InputError: the file does not exist; or the download failed, or gave another file, of which nothing stays.
    """
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    cached = tuple(folder / name for name in _WEIGHTS)
    if option is None:
        absent = [path.name for path in cached if not path.is_file()]
        if not absent:
            return LpipsWeights(cached, None)
        give = either("--lpips-weights", "output.lpips_weights")
        return LpipsWeights((), f"no weights ({' and '.join(absent)} not in {folder}); give {give}")
    if str(option) == "download":
        for path, (url, sha256) in zip(cached, _WEIGHTS.values(), strict=True):
            if not path.is_file() or _sha256(path) != sha256:
                _download(url, path, sha256)
        return LpipsWeights(cached, None)
    if not Path(option).is_file():
        raise InputError(f"LPIPS weights {option}: no such file; check the path, or say `download`")
    return LpipsWeights((Path(option),), None)


def _check_pair(image: Tensor, truth: Tensor) -> None:
    check_memory("image", image)
    check_memory("truth", truth)
    check_device("truth", truth, "image", image)
    if image.ndim != 3:
        raise ValueError(f"image: expected shape (H, W, C), got {tuple(image.shape)}")
    if image.shape != truth.shape:
        raise ValueError(f"truth: expected the image's shape {tuple(image.shape)}, got {tuple(truth.shape)}")
    check_floating("image", image)
    check_floating("truth", truth)
    if image.numel() == 0:
        raise ValueError(f"image: expected a pixel or more, got shape {tuple(image.shape)}")
    check_channels_last("image", image)
    if float(truth.mean()) > _BRIGHT:  # not of one that is NaN; the image may be what optimization left
        raise ValueError("truth: expected values in [0, 1], got others; divide by 255 what is from 0 to 255")


def _blur(planes: Float[Tensor, "M C H W"], padding: int) -> Float[Tensor, "M C H2 W2"]:
    """Separable Gaussian window; beyond the border there are zeros.

    Plane by plane, which the caches hold: torch's convolution of float64 takes fifteen times as long.
    """
    offsets = torch.arange(WINDOW, dtype=planes.dtype) - WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    weights = (window / window.sum()).tolist()
    with all_torch_threads():
        flat = planes.flatten(0, 1)
        blurred = [_weighted(_weighted(plane, weights, 0, padding), weights, 1, padding) for plane in flat]
        return torch.stack(blurred).unflatten(0, planes.shape[:2])


def _weighted(plane: Float[Tensor, "H W"], weights: Sequence[float], dim: int, padding: int) -> Float[Tensor, "H2 W2"]:
    """Sums of neighbours along a dimension, with the weights of a window, which are those of its mirror image."""
    padded = nn.functional.pad(plane, (padding, padding) if dim == 1 else (0, 0, padding, padding))
    reach = len(weights) // 2
    size = padded.shape[dim] - 2 * reach
    total = weights[reach] * padded.narrow(dim, reach, size)
    for k in range(reach):
        mirrored = padded.narrow(dim, len(weights) - 1 - k, size)
        total.add_(padded.narrow(dim, k, size) + mirrored, alpha=weights[k])
    return total


def _read_weights(path: Path) -> Mapping[str, Tensor]:
    if not path.is_file():
        raise InputError(f"LPIPS weights {path}: no such file; check the path")
    try:
        if kind_of(path) == ".safetensors":
            return load_file(path)
        entries = read_state_dict(path)
    except Exception as error:  # torch's unpickler raises anything, depending on the bytes
        detail = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"LPIPS weights {path}: not a readable weights file ({detail}); download it again") from error
    if not isinstance(entries, dict) or not all(isinstance(value, Tensor) for value in entries.values()):
        raise InputError(f"LPIPS weights {path}: not a state dict of tensors; see the documentation of Lpips")
    return entries


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        digest = hashlib.sha256()
        while chunk := file.read(1 << 20):
            digest.update(chunk)
        return digest.hexdigest()


def _download(url: str, path: Path, sha256: str) -> None:
    """Beside its place and then there, if it has the hash."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(path), hash_prefix=sha256, progress=False)
    except OSError as error:  # a refused connection, no route, a full disk
        raise InputError(f"LPIPS weights: {url} cannot be downloaded ({error}); give a file instead") from error
    except RuntimeError as error:
        raise InputError(f"LPIPS weights: {url} is another file now (its SHA-256 differs); give a file") from error
