"""What every task's run has in common: its place, its record and its events."""

import hashlib
import json
import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.engines.choice import engine_for
from etsplat.engines.threads import num_threads
from etsplat.io.kernel_files import kernel_digest, write_kernel
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.optim.loop import Event, Progress
from etsplat.optim.objective import Term
from etsplat.optim.schedules import Scheduled
from etsplat.optim.terms import named_terms
from etsplat.optim.trainer import Trainer
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
        run = RunDirectory.create(self.path, record, overwrite=self.overwrite)
        write_kernel(run.path, record["config"].get("method"))
        return run


def announcer(callbacks: Sequence[Callback]) -> Callback:
    """Calls each with every event."""

    def announce(event: Event | PrepareEvent | NoteEvent) -> None:
        for callback in callbacks:
            callback(event)

    return announce


def fit(
    trainer: Trainer[Any],
    config: ReconstructConfig | TrainConfig,
    run: RunDirectory,
    record: dict[str, Any],
    callbacks: Sequence[Callback],
) -> Progress:
    """Runs a trainer from the last checkpoint to the end, as settings and record say; see `Trainer.fit`."""
    output = config.output
    return trainer.fit(
        config.iterations,
        callbacks=callbacks,
        log_every=output.log_every,
        evaluate_every=output.evaluate_every,
        checkpoint_every=output.checkpoint_every,
        run=run,
        run_hash=hash_record(record),
    )


def terms_of(
    group: object,
    *,
    leaving: Collection[str] = (),
    scheduled: Mapping[str, Callable[[float], Scheduled]] | None = None,
    arguments: Mapping[str, Mapping[str, Any]] | None = None,
) -> list[Term]:
    """The terms whose weights `lambda_NAME` are settings, in the order of these.

    Args:
        group: the settings.
        leaving: names of weights of something else, or of terms that do not apply.
        scheduled: by name of a term, what becomes of its weight over the run, where it does not stay.
        arguments: by name, what else it is made with.
    """
    known, scheduled, arguments = named_terms(), scheduled or {}, arguments or {}
    weights = {key.removeprefix("lambda_"): value for key, value in vars(group).items() if key.startswith("lambda_")}
    return [
        known[name](scheduled[name](weight) if name in scheduled else weight, **arguments.get(name, {}))
        for name, weight in weights.items()
        if name not in leaving
    ]


def make_record(
    config: Settings, iterations: int, hashes: dict[str, str | None], paths: dict[str, str | None]
) -> dict[str, Any]:
    """What config.json holds. Inputs are identified by their hashes; paths are for the reader.

    Args:
        config: settings, as they were asked for.
        iterations: of this run, which may be fewer.
        hashes: of the input, by kind. That of a kernel from Python joins them.
        paths: where it was read from, by kind.
    """
    settings = config.to_dict()
    return {
        "task": config.TASK,
        "config": settings,
        "iterations": iterations,
        "source": {**hashes, **kernel_digest(settings.get("method"))},
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
