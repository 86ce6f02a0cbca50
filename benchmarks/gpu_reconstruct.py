"""Time of a whole step of shape reconstruction on a GPU, from the choice of a view to Adam's update."""

import time
from typing import Any

import torch

from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.engines.choice import engine
from etsplat.optim.trainer import Trainer
from etsplat.tasks.reconstruct import make_trainer
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starts import make_start


def step_milliseconds(
    device: torch.device, resolution: int = 1024, start_level: int = 6, faces: int = 100_000, steps: int = 512
) -> dict[str, Any]:
    """Milliseconds a step, as the task makes them, after one subdivision to ``faces`` faces and as many steps again.

    Wall time: steps are queued in the hundreds, and each batch ends with the one wait for the device.
    """
    warm_up = 10
    config = ReconstructConfig.paper().changed(
        {
            "resolution": resolution,
            "start.level": start_level,
            "max_faces": faces,
            "iterations": 2 * steps + warm_up,
            "refinement.first": warm_up / (2 * steps + warm_up),
            "refinement.last": warm_up / (2 * steps + warm_up),
            "refinement.subdivisions": 1,
        }
    )
    views = photograph(demo_object(), resolution, resolution, supersampling=1, device=device)
    with engine("cuda"):
        trainer = make_trainer(make_start(None, views, config, device).mesh, views, config)
        _advance(trainer, 0, config.iterations - steps)
        begin = time.perf_counter()
        _advance(trainer, config.iterations - steps, config.iterations)
    return {"faces": trainer.count, "milliseconds": 1e3 * (time.perf_counter() - begin) / steps}


def _advance(trainer: Trainer[Any], done: int, last: int) -> None:
    while done < last:
        done += len(trainer.advance(done + 1, last))
        trainer.refine(done)
