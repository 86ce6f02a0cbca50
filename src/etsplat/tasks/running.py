"""What every task's run has in common: its record, its events, and the loop from the last checkpoint to the end."""

import hashlib
import json
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from etsplat.io.run_directory import RunDirectory
from etsplat.optim.checkpoints import load_latest_checkpoint, save_checkpoint
from etsplat.optim.loop import Event, LoopSettings, Problem, Progress, StepEvent, optimize


@dataclass(frozen=True)
class PrepareEvent:
    """While the input is made ready (pictures are taken of a mesh, photos are decoded), before the first step.

    Attributes:
        done: views done.
        total: views in all.
    """

    done: int
    total: int


@dataclass(frozen=True)
class NoteEvent:
    """Something that the owner of the run should know, such as a repair made while reading the input.

    Attributes:
        text: a sentence.
    """

    text: str


Callback = Callable[[Event | PrepareEvent | NoteEvent], None]


class Resumable(Problem, Protocol):
    """A problem whose state can be written down and continued from."""

    def state(self, progress: Progress) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        ...

    def load_state(self, state: dict[str, Tensor], iteration: int) -> Progress:
        """Continues where `state` was taken; returns where that was."""
        ...


def fit(problem: Resumable, run: RunDirectory, settings: LoopSettings, run_hash: str, announce: Callback) -> Progress:
    """Runs the loop from the last checkpoint, or from the start, to the end, and keeps the history.

    Args:
        problem: changed in place.
        run: gets checkpoints and history.jsonl.
        settings: when things happen.
        run_hash: from `hash_record`.
        announce: called with every event.

    Raises:
        DivergedError: a loss or parameter is not finite.
        InputError: the checkpoint is damaged or of another run; the disk is full.
    """
    progress = Progress()
    checkpoint = load_latest_checkpoint(run.checkpoints, run_hash)
    if checkpoint is not None:
        progress = problem.load_state(checkpoint.tensors, checkpoint.iteration)
    run.truncate_history(progress.iteration)

    def save(at: Progress) -> Path:
        return save_checkpoint(run.checkpoints, at.iteration, problem.state(at), run_hash)

    for event in optimize(problem, settings, progress, save, run.checkpoints):
        if isinstance(event, StepEvent):
            place = {"iteration": event.iteration, "seconds": round(event.seconds, 3), "loss": event.loss}
            run.append_history({**place, **event.state, **event.metrics})
        announce(event)
    return progress


def make_record(
    task: str, config: object, hashes: dict[str, str | None], paths: dict[str, str | None]
) -> dict[str, Any]:
    """What config.json holds. Inputs are identified by their hashes; paths are for the reader."""
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in vars(config).items()}
    return {"task": task, "config": settings, "source": hashes, "paths": paths, "versions": versions()}


def hash_record(record: dict[str, Any]) -> str:
    """Identifies all that the result depends on."""
    relevant = {key: record[key] for key in ("task", "config", "source")}
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()


def path_of(source: object) -> str | None:
    """For the record: where a source was read from, if it was; absolute, so that it is found from any folder."""
    if not isinstance(source, str | Path):
        return None
    return str(Path(source).resolve()) if Path(source).exists() else str(source)  # the latter: "demo:scene"


def device_name(device: torch.device) -> str:
    """For the record: "cpu", or what the GPU is called."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def versions() -> dict[str, str]:
    """Of what computes."""
    return {"etsplat": version("etsplat"), "torch": torch.__version__, "python": platform.python_version()}


def progress_tensor(progress: Progress) -> Tensor:
    """For a checkpoint: everything of `progress` but the iteration."""
    return torch.tensor([progress.seconds, progress.loss_sum, progress.loss_count], dtype=torch.float64)


def read_progress(tensor: Tensor, iteration: int) -> Progress:
    """The inverse of `progress_tensor`."""
    seconds, loss_sum, loss_count = tensor.tolist()
    return Progress(iteration, seconds, loss_sum, int(loss_count))
