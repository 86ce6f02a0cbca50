"""Everything that is measured of a finished soup: image metrics per view in all conventions, and speed."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io.atomic import write_error
from etsplat.io.images import save_image, to_8_bit
from etsplat.metrics.image import Lpips, find_lpips_weights, psnr, ssim
from etsplat.ops.engines import num_threads, resolve_device, resolve_engine
from etsplat.scene.captures import Capture
from etsplat.scene.soup_rendering import render_soup
from etsplat.tasks.running import device_name
from etsplat.tasks.soup_run import SoupRun
from etsplat.tasks.soup_scoring import SoupScorer

REPEATS = 3
"""Every view is timed so often, after one picture that is not counted; the best time counts."""

_SMALLEST = 16
"""Pixels a side below which LPIPS is not defined."""


@dataclass(frozen=True)
class _Pair:
    """A test view: name, photograph and the same view of the soup, splatted and opaque; masked pixels agree."""

    name: str
    photo: Float[Tensor, "H W 3"]
    soft: Float[Tensor, "H W 3"]
    opaque: Float[Tensor, "H W 3"]


def evaluate_run(
    run: SoupRun,
    *,
    lpips_weights: Path | str | None = None,
    pictures: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure a soup on the test views of its capture.

    Args:
        run: with its capture.
        lpips_weights: as `etsplat.metrics.image.find_lpips_weights` takes it.
        pictures: folder for NAME.png of every test view: photograph, soup, opaque triangles, and the error times 4.
        progress: called with (views done, views in all).

    Returns:
        Means over the test views by name: psnr and psnr_8bit (of renders rounded to 8 bits, as published numbers are),
        ssim (zero-padded), ssim_interior, lpips (inputs scaled to [-1, 1]) and lpips_3dgs (not scaled), each also with
        `_opaque` for the opaque triangles; `views`, the same for each; fps, ms_per_frame, ms_per_million and their
        circumstances. On a GPU where there is one. null where something could not be measured, `lpips_reason` says why.

    Raises:
        InputError: no capture, no test views, weights that cannot be read, `pictures` cannot be written to.
    """
    capture = run.needed_capture()
    if not capture.test:
        raise InputError(f"{run.path}: the capture has no test views; there is nothing to measure")
    weights = find_lpips_weights(lpips_weights)
    lpips = Lpips.from_weights(*weights.paths) if weights.paths else None
    if pictures is not None:
        try:
            pictures.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(pictures, error) from error
    device = resolve_device(None, None)
    run = replace(run, file=replace(run.file, soup=run.file.soup.to(device)))
    if lpips is not None:
        lpips.to(device)
    scorer = SoupScorer(capture, torch.tensor(run.file.background), None, device)
    rows: list[dict[str, Any]] = []
    for index, view in enumerate(capture.test):
        pair = _pair(run, scorer, capture.names[view], view)
        soft, opaque = _scores(pair.soft, pair, lpips, ""), _scores(pair.opaque, pair, lpips, "_opaque")
        rows.append({"name": pair.name, **soft, **opaque})
        if pictures is not None:
            error = (4 * (pair.soft - pair.photo).abs()).clamp(0, 1)
            save_image(pictures / f"{pair.name}.png", torch.cat([pair.photo, pair.soft, pair.opaque, error], dim=1))
        if progress is not None:
            progress(index + 1, len(capture.test))
    names = [name for name in rows[0] if name != "name"]
    means = {name: _mean([row[name] for row in rows]) for name in names}
    return {**means, "lpips_reason": weights.reason, **_speed(run, capture), "views": rows}


def _pair(run: SoupRun, scorer: SoupScorer, name: str, view: int) -> _Pair:
    soup, appearance = run.file.soup, run.file.appearance
    photo = scorer.photo(view)
    soft = scorer.masked(scorer.splatted(soup, appearance, view), photo, view)
    opaque = scorer.masked(scorer.opaque(soup, appearance, view), photo, view)
    return _Pair(name, photo, soft, opaque)


def _scores(image: Float[Tensor, "H W 3"], pair: _Pair, lpips: Lpips | None, suffix: str) -> dict[str, float | None]:
    smallest = min(image.shape[:2])
    measured = lpips if smallest >= _SMALLEST else None
    scores: dict[str, float | None] = {
        "psnr": psnr(image, pair.photo),
        "psnr_8bit": psnr(to_8_bit(image).float() / 255, to_8_bit(pair.photo).float() / 255),
        "ssim": ssim(image, pair.photo),
        "ssim_interior": ssim(image, pair.photo, interior=True) if smallest >= 11 else None,
        "lpips": None if measured is None else float(measured(image, pair.photo)),
        "lpips_3dgs": None if measured is None else float(measured(image, pair.photo, rescale=False)),
    }
    return {f"{name}{suffix}": value for name, value in scores.items()}


@torch.no_grad()
def _speed(run: SoupRun, capture: Capture) -> dict[str, Any]:
    """Pictures of the test views one after the other, colour only; the mean over views of each one's best time."""
    cameras = [capture.cameras[view] for view in capture.test]
    device = run.file.soup.vertices.device
    background = torch.tensor(run.file.background, device=device)[None]
    best = []
    for camera in (camera.to(device) for camera in cameras):
        times = []
        for repeat in range(REPEATS + 1):
            start = time.perf_counter()
            render_soup(run.file.soup, camera, run.file.appearance, backgrounds=background)
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            if repeat:
                times.append(time.perf_counter() - start)
        best.append(min(times))
    seconds, triangles = statistics.fmean(best), len(run.file.soup)
    return {
        "fps": 1 / seconds,
        "ms_per_frame": 1e3 * seconds,
        "ms_per_million": 1e3 * seconds / (triangles / 1e6),
        "triangles": triangles,
        "width": cameras[0].width,
        "height": cameras[0].height,
        "engine": resolve_engine(None, run.file.soup.vertices),
        "device": device_name(device),
        "threads": num_threads(),
    }


def _mean(values: list[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return statistics.fmean(present) if len(present) == len(values) else None
