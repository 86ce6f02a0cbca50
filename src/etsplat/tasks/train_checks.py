"""What is refused before a run of novel-view synthesis, and what its owner should know."""

from dataclasses import replace

import torch

from etsplat.core.errors import InputError
from etsplat.core.spelling import either, option
from etsplat.data.dataset import Dataset
from etsplat.data.dataset_checks import check_training_views
from etsplat.optim.trainer_checks import USUAL_EXTENT
from etsplat.tasks.pixel_limits import random_count, triangle_limit
from etsplat.tasks.train_config import TrainConfig
from etsplat.tasks.train_memory import check_memory


def check_train(
    capture: Dataset,
    config: TrainConfig,
    iterations: int,
    device: torch.device,
    around: int = 0,
    *,
    streams: bool = False,
) -> list[str]:
    """Refuses what cannot work; returns what the owner of a run of so many iterations should know.

    Args:
        capture: photos.
        config: settings.
        iterations: of the run.
        device: where it runs.
        around: bytes of triangles that are drawn as well (`bytes_around`).
        streams: whether photos are decoded anew on purpose, as those of all blocks.
    """
    check_training_views(capture.train)
    masks = (capture.images.mask(view) for view in capture.train)
    if not capture.images.streamed and all(mask is not None and not bool(mask.any()) for mask in masks):
        raise InputError("masks: leave out every pixel of all training photos; they are white where pixels count")
    needed = check_memory(
        capture, replace(config, iterations=iterations), triangle_limit(capture, config), device, around
    )
    aside = f", {len(capture.watched)} to watch the run" if capture.watched else ""
    views = f"{len(capture.train)} photos to train on{aside}, {len(capture.test)} to test"
    notes = [f"{views}; {needed}"]
    if iterations < config.iterations:
        limit = f"schedule.max_epochs {config.schedule.max_epochs}"
        notes.append(f"few photos: {iterations:,} iterations, not {config.iterations:,} ({limit})")
    if (limit := triangle_limit(capture, config)) < config.max_triangles:
        setting = f"pixels_per_triangle {config.pixels_per_triangle:g}"
        notes.append(f"few pixels: at most {limit:,} triangles, not {config.max_triangles:,} ({setting})")
    if capture.exact_points is not None and (points := len(capture.exact_points)) > limit:
        notes.append(
            f"{points:,} points, each of which becomes a triangle: more than the limit of {limit:,}, so that none are"
            " added; thin the points out if these are too many"
        )
    if capture.images.streamed and not streams:
        notes.append("the photos do not fit into memory: they are decoded anew whenever they are needed")
    if capture.exact_points is None:
        maps = ["its depth maps"] if capture.images.with_depth and config.loss.depth != "off" else []
        photos = ["its photos"] if config.start.dense and config.finish == "none" else []
        unless = f" unless {' or '.join(maps + photos)} agree" if maps or photos else ""
        notes.append(f"no points in the capture: starting from {random_count(capture, config):,} random ones{unless}")
    if config.sky != "none" and _cut_out(capture):
        as_object = either("--scene-type object", 'TrainConfig.of(preset, "object")')
        notes.append(
            "photos: have transparent pixels, and behind them a scene has a sky, which nothing holds there; of an"
            f" object that is cut out, take {as_object}"
        )
    if doubt := doubtful_scale(capture, config):
        notes.append(doubt)
    return notes


def _cut_out(capture: Dataset) -> bool:
    """Whether the first photo says of any pixel that nothing is there."""
    pixels = capture.images[capture.train[0]]
    return pixels.shape[-1] == 4 and bool((pixels[..., 3] == 0).any())


def doubtful_scale(capture: Dataset, config: TrainConfig) -> str | None:
    """What to do about a scene whose size the absolute settings were not made for, if it is one."""
    low, high = USUAL_EXTENT
    if config.normalize or low <= capture.extent <= high:
        return None
    return (
        f"the cameras are spread over {capture.extent:.4g} units, and the settings are made for {low:g} to {high:g}: "
        f"start again with {option('normalize', True)}, which scales the scene"
    )
