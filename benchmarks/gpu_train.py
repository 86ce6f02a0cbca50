"""Time of a whole step of novel-view synthesis on a GPU, from the choice of a view to statistics, and its kernels."""

import statistics
import time
from typing import Any

import torch

from benchmarks.gpu_timing import kernel_times
from etsplat.data.demo_scene import demo_scene
from etsplat.engines.choice import engine
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.trainer import Trainer
from etsplat.tasks.soup_trainer import make_trainer
from etsplat.tasks.train_config import TrainConfig

SIZE = (1237, 822)
TRIANGLES = 4_000_000
EXTENT = 0.004
"""Of a triangle, about six pixels across from where the cameras are."""


def step_milliseconds(
    device: torch.device,
    preset: str,
    *,
    size: tuple[int, int] = SIZE,
    triangles: int = TRIANGLES,
    steps: int = 64,
) -> dict[str, Any]:
    """Milliseconds a step, as the task makes them, over views that take turns.

    Wall time: steps are queued together, and the batch ends with the one wait for the device. The median of three
    batches: one in which a view needs more room than any before makes its steps again.

    Args:
        device: where it runs.
        preset: "quick", or "paper" with all its losses from the first iteration on.
        size: width and height of the photos.
        triangles: random ones around the scene; none is added or removed.
        steps: how many are timed together; as many before them are not.
    """
    capture = demo_scene(*size)
    generator = torch.Generator().manual_seed(0)
    middles = 0.6 * torch.randn((triangles, 1, 3), generator=generator)
    vertices = middles + EXTENT * torch.randn((triangles, 3, 3), generator=generator)
    colors = torch.rand((triangles, 3), generator=generator)
    soup = TriangleSoup.from_triangles(vertices, colors, opacity=0.3, sigma=0.5, sh_degree=3).to(device)
    config = TrainConfig.of(preset, "indoor").changed(
        {"iterations": 30_000, "schedule.sh_every": 1, "densification.every": 15_000}
    )
    if config.loss.lambda_distortion > 0:
        config = config.changed({"loss.regularize_from": 0})
    with engine("cuda"):
        trainer = make_trainer(soup, capture, config, generator=generator)
        done = _advance(trainer, 10, 10 + steps)
        batches = []
        for _ in range(3):
            begin = time.perf_counter()
            done = _advance(trainer, done, done + steps)
            batches.append(1e3 * (time.perf_counter() - begin) / steps)
        kernels = {}
        if device.type == "cuda":
            kernels = kernel_times(lambda: trainer.advance(done + 1, done + 1), 8)
    return {"triangles": triangles, "size": size, "milliseconds": statistics.median(batches), "kernels": kernels}


def _advance(trainer: Trainer[TriangleSoup], done: int, last: int) -> int:
    while done < last:
        done += len(trainer.advance(done + 1, last))
    return done
