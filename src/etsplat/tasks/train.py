"""Novel-view synthesis (paper section 3.4): photos in, a run directory with a triangle soup out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import HEIGHT, WIDTH, demo_scene
from etsplat.data.load import load_dataset
from etsplat.data.loader import stay_on
from etsplat.engines.choice import engine, engine_for, resolve_device
from etsplat.io.memory import available_memory
from etsplat.io.run_directory import RunDirectory
from etsplat.model.soup_files import SoupFile, save_soup
from etsplat.model.soup_init import StartPoints, random_points, start_soup
from etsplat.model.surroundings import SPHERE_TRIANGLES, Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import CheckpointEvent, DivergedError, Progress
from etsplat.optim.schedules import limited_iterations
from etsplat.tasks.running import (
    Callback,
    NoteEvent,
    Place,
    PrepareEvent,
    announcer,
    common_metrics,
    fit,
    loop_settings,
    make_record,
    path_of,
)
from etsplat.tasks.soup_fitting import Evaluate, SoupFitting
from etsplat.tasks.soup_scoring import SoupScorer
from etsplat.tasks.train_config import TrainConfig

DEMO = "demo:scene"
"""Names the scene that is built in code."""

BYTES_PER_TRIANGLE = 1500
"""Parameters, gradients, moments, statistics, what the rasterizer keeps, and the copies while triangles multiply."""

BYTES_PER_PIXEL = 400
"""Of the step's images and the rasterizer's lists."""

LARGE_SPAN = 300.0
"""Above this many units across, Triangle Splatting compares outdoor scenes by squares."""

USUAL_EXTENT = (0.5, 50.0)
"""Extents of the scenes that the paper's absolute settings were made for, generously."""


@dataclass(frozen=True)
class TrainResult:
    """What a run gives back; all of it is in the run directory too.

    Attributes:
        path: the run directory.
        soup: the triangles, in the units of the input.
        metrics: as in metrics.json.
    """

    path: Path
    soup: TriangleSoup
    metrics: dict[str, Any]


def train(
    source: str | Path | Dataset,
    out: str | Path,
    config: TrainConfig | None = None,
    *,
    images: str | None = None,
    masks: str | Path | None = None,
    callbacks: Sequence[Callback] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> TrainResult:
    """Fits a triangle soup to the photos of a scene.

    A run ends with the same bits on the same machine, torch and number of threads, also if it was killed and resumed
    any number of times. Ctrl-C leaves a checkpoint of the last whole iteration.

    Args:
        source: a folder with posed photos (COLMAP, nerfstudio, Blender), a `Dataset` in its own units, or "demo:scene".
        out: the run directory; made if it does not exist. README.txt in it explains what is there.
        config: settings; None for preset "quick", outdoor. See `TrainConfig`.
        images: folder in the scene to take the photos from, such as "images_4".
        masks: folder with a mask for every photo, white where pixels count.
        callbacks: each is called with every event, in the thread of the caller.
        resume: continue the run in `out`, which must have been started with the same source and settings.
        overwrite: replace a run in `out`. Nothing but files of a run is ever removed.

    Raises:
        InputError: something handed in cannot be used; earlier results in `out` are as they were.
        DivergedError: the optimization went to NaN or infinity.
    """
    config = config or TrainConfig()
    device = resolve_device(config.device, config.engine)
    place, announce = Place(Path(out), resume, overwrite), announcer(callbacks)
    place.check()
    own = _load(source, config, images, masks, lambda done, total: announce(PrepareEvent(done, total)))
    capture = own.normalized() if config.normalize else own
    iterations = limited_iterations(config.iterations, config.schedule.max_epochs, len(own.train))
    for note in _check(own, config, iterations, device):
        announce(NoteEvent(note))
    paths = {"source": path_of(source), "images": images, "masks": path_of(masks)}
    record = make_record(config, iterations, {"fingerprint": own.fingerprint()}, paths)
    config = replace(config, iterations=iterations)
    scorer = SoupScorer(capture, _background(config), device)
    with engine(config.engine):
        fitting = start_fitting(capture, config, scorer.cheap, device)
        run = place.open(record)

        def keep(event: Any) -> None:
            if isinstance(event, CheckpointEvent):  # so that `etsplat view` can follow
                save_soup(run.soup_path, _soup_file(fitting, event.iteration, capture, config))
            announce(event)

        with engine_for(fitting.soup.vertices).looping():
            try:
                progress = fit(fitting, run, loop_settings(config), record, keep)
            except DivergedError as error:
                if doubt := _doubtful_scale(own, config):
                    raise DivergedError(f"{error}. But first: {doubt}") from error
                raise
            return _finish(fitting, progress, run, scorer, capture, config)


def start_fitting(
    capture: Dataset, config: TrainConfig, evaluate: Evaluate, device: torch.device | None = None
) -> SoupFitting:
    """The start of a run: triangles at the capture's points, or at random ones.

    Args:
        capture: in the frame that is trained in.
        config: settings.
        evaluate: cheap metrics of a soup.
        device: where the soup lives; None for the CPU.
    """
    generator = torch.Generator().manual_seed(config.seed)
    points = _start_points(capture, config, generator)
    soup = start_soup(
        points,
        generator,
        scale=config.start.scale,
        opacity=config.start.opacity,
        sigma=config.start.sigma,
        sh_degree=config.drawing.sh_degree,
        centers=capture.centers[capture.train],
        limit=config.start.limit,
    )
    if config.sky == "sphere":
        soup = soup.joined(Surroundings.of(capture).soup(capture, config.drawing.sh_degree))
    soup = soup.to(device or torch.device("cpu"))
    squared = config.scene_type == "outdoor" and not config.normalize and _span(points) > LARGE_SPAN
    return SoupFitting(soup, capture, config, generator, evaluate, squared=squared)


def demo_capture(width: int | None, progress: Callable[[int, int], None] | None = None) -> Dataset:
    """The scene that is built in code, in photos no wider than a setting asks for; None for their usual width."""
    width = min(WIDTH, width or WIDTH)
    return demo_scene(width, max(1, round(HEIGHT * width / WIDTH)), progress=progress)


def predicted_bytes(capture: Dataset, config: TrainConfig, device: torch.device | None = None) -> int:
    """Memory of a device, None for the CPU, that a run may come to need, beyond the program itself."""
    pixels = max(width * height for width, height in capture.images.sizes)
    triangles = max(config.max_triangles, _start_count(capture, config))
    kept = not capture.images.streamed and (device is None or stay_on(device, capture.images.total_bytes))
    pictures = capture.images.total_bytes if kept else 0
    return triangles * BYTES_PER_TRIANGLE + pixels * BYTES_PER_PIXEL + pictures


def _load(
    source: str | Path | Dataset,
    config: TrainConfig,
    images: str | None,
    masks: str | Path | None,
    progress: Callable[[int, int], None],
) -> Dataset:
    if isinstance(source, Dataset):
        return source
    if str(source) == DEMO:
        return demo_capture(config.width, progress)
    return load_dataset(source, images=images, width=config.width, masks=masks, progress=progress)


def _check(capture: Dataset, config: TrainConfig, iterations: int, device: torch.device) -> list[str]:
    """Refuses what cannot work; returns what the owner of a run of so many iterations should know."""
    if not capture.train:
        raise InputError("capture: has no view to train on; name some in its split")
    needed = predicted_bytes(capture, config, device)
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else available_memory()
    if needed > free:
        fitting = max(1000, int(config.max_triangles - (needed - free) / BYTES_PER_TRIANGLE))
        raise InputError(
            f"max_triangles: {config.max_triangles:,} triangles may need {needed / 2**30:.1f} GiB and "
            f"{free / 2**30:.1f} GiB are free; set it to {fitting} or less"
        )
    notes = [
        f"{len(capture.train)} photos to train on, {len(capture.test)} to test; at most {_amount(needed)} of memory"
    ]
    if iterations < config.iterations:
        limit = f"schedule.max_epochs {config.schedule.max_epochs}"
        notes.append(f"few photos: {iterations:,} iterations, not {config.iterations:,} ({limit})")
    if capture.images.streamed:
        notes.append("the photos do not fit into memory: they are decoded anew whenever they are needed")
    if capture.exact_points is None:
        notes.append(f"no points in the capture: starting from {config.start.points:,} random ones")
    if doubt := _doubtful_scale(capture, config):
        notes.append(doubt)
    return notes


def _doubtful_scale(capture: Dataset, config: TrainConfig) -> str | None:
    """What to do about a scene whose size the absolute settings were not made for, if it is one."""
    low, high = USUAL_EXTENT
    if config.normalize or low <= capture.extent <= high:
        return None
    return (
        f"the cameras are spread over {capture.extent:.4g} units, and the settings are made for {low:g} to {high:g}: "
        "start again with --normalize, which scales the scene"
    )


def _amount(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count >> 20} MiB"


def _start_count(capture: Dataset, config: TrainConfig) -> int:
    points = config.start.points if capture.exact_points is None else len(capture.exact_points)
    return points + (SPHERE_TRIANGLES if config.sky == "sphere" else 0)


def _start_points(capture: Dataset, config: TrainConfig, generator: torch.Generator) -> StartPoints:
    """The capture's points, or random ones in a cube that holds what the cameras look at."""
    positions, colors = capture.points, capture.point_colors
    if positions is None:
        points = random_points(config.start.points, capture.viewmats[capture.train], generator)
    else:
        grey = torch.full_like(positions, 0.5)
        points = StartPoints(positions, grey if colors is None else colors)
    return points.with_sky() if config.sky == "dome" else points


def _background(config: TrainConfig) -> Float[Tensor, "3"]:
    """Behind the pictures that are measured."""
    return torch.full((3,), 1.0 if config.background == "white" else 0.0)


def _span(points: StartPoints) -> float:
    """Longest side of the box around the points."""
    return float((points.positions.amax(dim=0) - points.positions.amin(dim=0)).max()) if len(points) else 0.0


def _finish(
    fitting: SoupFitting,
    progress: Progress,
    run: RunDirectory,
    scorer: SoupScorer,
    capture: Dataset,
    config: TrainConfig,
) -> TrainResult:
    """Writes the soup in the input's units, draws the test views, measures everything."""
    soup, appearance = fitting.finished()
    scores = scorer.full(soup, appearance, run.test)
    file = _soup_file(fitting, progress.iteration, capture, config)
    save_soup(run.soup_path, file)
    metrics = {
        **scores,
        "psnr_opaque_loss": None if scores["psnr"] is None else scores["psnr"] - scores["psnr_opaque"],
        "triangles": len(soup),
        **fitting.describe(),
        "width": capture.images.sizes[0][0],
        "height": capture.images.sizes[0][1],
        "train_views": len(capture.train),
        "scene_type": config.scene_type,
        "finish": config.finish,
        **common_metrics(progress, config, soup.vertices),
    }
    run.write_metrics(metrics)
    return TrainResult(run.path, file.soup, run.read_metrics())


def _soup_file(fitting: SoupFitting, iteration: int, capture: Dataset, config: TrainConfig) -> SoupFile:
    """The soup as it is now, in the input's units."""
    soup, appearance = fitting.finished()
    soup, own, grey = soup.to(torch.device("cpu")), capture.normalization, float(_background(config)[0])
    return SoupFile(
        replace(soup, vertices=own.invert(soup.vertices.double()).float()),
        replace(appearance, near_plane=appearance.near_plane * own.radius),
        (grey, grey, grey),
        {"iteration": str(iteration), "method": config.method, "preset": config.preset},
    )
