"""Everything that is measured of a finished soup: image metrics per view in all conventions, and speed."""

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.engines.choice import engine_for
from etsplat.engines.threads import num_threads
from etsplat.io.atomic import write_error
from etsplat.io.images import save_image
from etsplat.tasks.running import device_name
from etsplat.tasks.scoring import Scorer, image_scores, load_lpips
from etsplat.tasks.soup_run import SoupRun

REPEATS = 3
"""Every view is timed so often, after one picture that is not counted; the best time counts."""


def evaluate_run(
    run: SoupRun,
    *,
    lpips_weights: Path | str | None = None,
    pictures: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure a soup on the test views of its capture.

    Args:
        run: with its capture; measured on its device.
        lpips_weights: as `etsplat.metrics.image.find_lpips_weights` takes it.
        pictures: folder for NAME.png of every test view: photograph, soup, opaque triangles, and the error times 4.
        progress: called with (views done, views in all).

    Returns:
        Means over the test views by name: psnr and psnr_8bit (of renders rounded to 8 bits, as published numbers are),
        ssim (zero-padded), ssim_interior, lpips (inputs scaled to [-1, 1]) and lpips_3dgs (not scaled), each also with
        `_opaque` for the opaque triangles; `views`, the same for each; fps, ms_per_frame, ms_per_million and their
        circumstances. null where something could not be measured, `lpips_reason` says why.

    Raises:
        InputError: no capture, no test views, weights that cannot be read, `pictures` cannot be written to.
    """
    capture = run.needed_capture()
    if not capture.test:
        raise InputError(f"{run.path}: the capture has no test views; there is nothing to measure")
    if pictures is not None:
        try:
            pictures.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(pictures, error) from error
    place, soup = run.device, run.soup
    lpips, reason = load_lpips(lpips_weights, place)
    background = soup.appearance.background
    scorer = Scorer(capture, place, background=background)
    rows: list[dict[str, Any]] = []
    for index, view in enumerate(capture.test):
        seen = scorer.see(soup, view)
        photo, soft, opaque = seen.photo, seen.counting(seen.splatted), seen.counting(seen.opaque)
        name, scores = capture.names[view], image_scores(soft, photo, lpips)
        rows.append({"name": name, **scores, **image_scores(opaque, photo, lpips, suffix="_opaque")})
        if pictures is not None:
            error = (4 * (soft - photo).abs()).clamp(0, 1)
            save_image(pictures / f"{name}.png", torch.cat([photo, soft, opaque, error], dim=1))
        if progress is not None:
            progress(index + 1, len(capture.test))

    def draw(camera: Cameras) -> None:
        soup.render(camera, backgrounds=torch.tensor([background], device=place))

    cameras = [capture.cameras[view] for view in capture.test]
    speed = {**drawing_speed(draw, cameras, place, len(soup)), "engine": engine_for(soup.vertices).name}
    return {**mean_scores(rows), "lpips_reason": reason, **speed, "triangles": len(soup), "views": rows}


def mean_scores(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Means over views, of what was measured in all of them."""
    columns = {name: [row[name] for row in rows] for name in rows[0] if name != "name"}
    return {name: None if None in values else statistics.fmean(values) for name, values in columns.items()}


@torch.no_grad()
def drawing_speed(
    draw: Callable[[Cameras], object], cameras: Sequence[Cameras], device: torch.device, primitives: int
) -> dict[str, Any]:
    """Pictures one after the other, colour only; the mean over cameras of each one's best time."""
    best = []
    for camera in (camera.to(device) for camera in cameras):
        times = []
        for repeat in range(REPEATS + 1):
            start = time.perf_counter()
            draw(camera)
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            if repeat:
                times.append(time.perf_counter() - start)
        best.append(min(times))
    seconds = statistics.fmean(best)
    return {
        "fps": 1 / seconds,
        "ms_per_frame": 1e3 * seconds,
        "ms_per_million": 1e3 * seconds / (primitives / 1e6),
        "width": cameras[0].width,
        "height": cameras[0].height,
        "device": device_name(device),
        "threads": num_threads(),
    }
