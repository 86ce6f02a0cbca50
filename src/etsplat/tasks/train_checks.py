"""What is refused before a run of novel-view synthesis, and what its owner should know."""

import torch

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.loader import stay_on
from etsplat.io.memory import available_memory
from etsplat.model.surroundings import SPHERE_TRIANGLES
from etsplat.tasks.train_config import TrainConfig

BYTES_PER_TRIANGLE = 1500
"""Parameters, gradients, moments, statistics, what the rasterizer keeps, and the copies while triangles multiply."""

BYTES_PER_PIXEL = 400
"""Of the step's images and the rasterizer's lists."""

USUAL_EXTENT = (0.5, 50.0)
"""Extents of the scenes that the paper's absolute settings were made for, generously."""


def check_train(capture: Dataset, config: TrainConfig, iterations: int, device: torch.device) -> list[str]:
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
    aside = f", {len(capture.watched)} to watch the run" if capture.watched else ""
    views = f"{len(capture.train)} photos to train on{aside}, {len(capture.test)} to test"
    notes = [f"{views}; at most {_amount(needed)} of memory"]
    if iterations < config.iterations:
        limit = f"schedule.max_epochs {config.schedule.max_epochs}"
        notes.append(f"few photos: {iterations:,} iterations, not {config.iterations:,} ({limit})")
    if (limit := triangle_limit(capture, config)) < config.max_triangles:
        setting = f"pixels_per_triangle {config.pixels_per_triangle:g}"
        notes.append(f"few pixels: at most {limit:,} triangles, not {config.max_triangles:,} ({setting})")
    if capture.images.streamed:
        notes.append("the photos do not fit into memory: they are decoded anew whenever they are needed")
    if capture.exact_points is None:
        notes.append(f"no points in the capture: starting from {config.start.points:,} random ones")
    if doubt := doubtful_scale(capture, config):
        notes.append(doubt)
    return notes


def triangle_limit(capture: Dataset, config: TrainConfig) -> int:
    """How many triangles there may be: `max_triangles`, or fewer where the training photos have few pixels."""
    if config.pixels_per_triangle is None:
        return config.max_triangles
    pixels = sum(width * height for width, height in (capture.images.sizes[index] for index in capture.train))
    return min(config.max_triangles, max(1, int(pixels / config.pixels_per_triangle)))


def doubtful_scale(capture: Dataset, config: TrainConfig) -> str | None:
    """What to do about a scene whose size the absolute settings were not made for, if it is one."""
    low, high = USUAL_EXTENT
    if config.normalize or low <= capture.extent <= high:
        return None
    return (
        f"the cameras are spread over {capture.extent:.4g} units, and the settings are made for {low:g} to {high:g}: "
        "start again with --normalize, which scales the scene"
    )


def predicted_bytes(capture: Dataset, config: TrainConfig, device: torch.device | None = None) -> int:
    """Memory of a device, None for the CPU, that a run may come to need, beyond the program itself."""
    pixels = max(width * height for width, height in capture.images.sizes)
    points = config.start.points if capture.exact_points is None else len(capture.exact_points)
    triangles = max(triangle_limit(capture, config), points + (SPHERE_TRIANGLES if config.sky == "sphere" else 0))
    kept = not capture.images.streamed and (device is None or stay_on(device, capture.images.total_bytes))
    pictures = capture.images.total_bytes if kept else 0
    return triangles * BYTES_PER_TRIANGLE + pixels * BYTES_PER_PIXEL + pictures


def _amount(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count >> 20} MiB"
