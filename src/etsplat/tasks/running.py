"""What every task's run has in common: its record, its events, and the loop from the last checkpoint to the end."""

import hashlib
import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.engines.choice import engine_for
from etsplat.engines.threads import num_threads
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.optim.checkpoints import load_latest_checkpoint, save_checkpoint
from etsplat.optim.loop import Event, LoopSettings, Problem, Progress, StepEvent, optimize
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Settings
from etsplat.tasks.train_config import TrainConfig


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


@dataclass(frozen=True)
class Place:
    """Where a run goes, and what happens to what is there.

    Attributes:
        path: the run directory.
        resume: continue the run in it.
        overwrite: replace a run in it.
    """

    path: Path
    resume: bool
    overwrite: bool

    def check(self) -> None:
        """Cheap, so that it comes before the input is prepared.

        Raises:
            InputError: there is no run to continue, or no place for a new one; or both are asked for.
        """
        if self.resume and self.overwrite:
            raise InputError("--resume and --overwrite: contradict each other; give one of them")
        if not self.resume:
            RunDirectory.check_free(self.path, overwrite=self.overwrite)
        elif not is_run(self.path):
            raise InputError(f"{self.path}: holds no run to resume; start it without --resume")

    def open(self, record: dict[str, Any]) -> RunDirectory:
        """The directory, made or with the run that goes on; ``record`` as of `make_record`.

        Raises:
            InputError: as `check`; or the run in it was started with other settings or input.
        """
        if self.resume:
            return RunDirectory.resume(self.path, record)
        return RunDirectory.create(self.path, record, overwrite=self.overwrite)


def announcer(callbacks: Sequence[Callback]) -> Callback:
    """Calls each with every event."""

    def announce(event: Event | PrepareEvent | NoteEvent) -> None:
        for callback in callbacks:
            callback(event)

    return announce


def fit(
    problem: Resumable,
    run: RunDirectory,
    settings: LoopSettings,
    record: dict[str, Any],
    announce: Callback,
) -> Progress:
    """Runs the loop from the last checkpoint, or from the start, to the end, and keeps the history.

    Args:
        problem: changed in place.
        run: gets checkpoints and history.jsonl.
        settings: when things happen.
        record: from `make_record`.
        announce: called with every event.

    Raises:
        DivergedError: a loss or parameter is not finite.
        InputError: the checkpoint is damaged or of another run; the disk is full.
    """
    run_hash = hash_record(record)
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


def loop_settings(config: ReconstructConfig | TrainConfig) -> LoopSettings:
    """When things happen, for `fit`."""
    output = config.output
    return LoopSettings(config.iterations, output.log_every, output.evaluate_every, output.checkpoint_every)


def make_record(
    config: Settings, iterations: int, hashes: dict[str, str | None], paths: dict[str, str | None]
) -> dict[str, Any]:
    """What config.json holds. Inputs are identified by their hashes; paths are for the reader.

    Args:
        config: settings, as they were asked for.
        iterations: of this run, which may be fewer.
        hashes: of the input, by kind.
        paths: where it was read from, by kind.
    """
    return {
        "task": config.TASK,
        "config": config.to_dict(),
        "iterations": iterations,
        "source": hashes,
        "paths": paths,
        "versions": versions(),
    }


def hash_record(record: dict[str, Any]) -> str:
    """Identifies all that the result depends on."""
    relevant = {key: record[key] for key in ("task", "config", "source")}
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()


def path_of(source: object) -> str | None:
    """For the record: where a source was read from, if it was; absolute, so that it is found from any folder."""
    if not isinstance(source, str | Path):
        return None
    return str(Path(source).resolve()) if Path(source).exists() else str(source)  # the latter: "demo:scene"


def common_metrics(progress: Progress, config: ReconstructConfig | TrainConfig, result: Tensor) -> dict[str, Any]:
    """What metrics.json says of every run: how long it took, on what, and how it was made.

    Args:
        progress: at the end.
        config: settings.
        result: a tensor of the result, for its device and precision.
    """
    return {
        "iterations": progress.iteration,
        "seconds": progress.seconds,
        "seconds_per_iteration": progress.seconds / progress.iteration,
        "engine": engine_for(result).name,
        "device": device_name(result.device),
        "threads": num_threads(),
        "method": config.method,
        "preset": config.preset,
        "seed": config.seed,
        "versions": versions(),
    }


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
