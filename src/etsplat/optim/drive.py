"""From the last checkpoint, or from the start, to the end of a run, with its history."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from etsplat.io.run_directory import RunDirectory
from etsplat.optim.checkpoints import load_latest_checkpoint, save_checkpoint
from etsplat.optim.loop import Event, LoopSettings, Problem, Progress, StepEvent, optimize

Callback = Callable[[Event], None]


class Resumable(Problem, Protocol):
    """A problem whose state can be written down and continued from."""

    def state(self) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        ...

    def load_state(self, state: dict[str, Tensor], iteration: int) -> None:
        """Continues where `state` was taken."""
        ...


def drive(
    problem: Resumable,
    progress: Progress,
    settings: LoopSettings,
    callbacks: Sequence[Callback],
    run: RunDirectory | None,
    run_hash: str,
) -> None:
    """Runs the loop to the last iteration.

    Args:
        problem: changed in place.
        progress: where it stands; changed in place. A checkpoint in `run` takes its place.
        settings: when things happen.
        callbacks: each is called with every event.
        run: gets checkpoints and history.jsonl; None writes nothing.
        run_hash: identifies all that the result depends on.

    Raises:
        DivergedError: a loss or parameter is not finite.
        InputError: the checkpoint is damaged or of another run; the disk is full.
    """
    if run is not None:
        checkpoint = load_latest_checkpoint(run.checkpoints, run_hash)
        if checkpoint is not None:
            problem.load_state(checkpoint.tensors, checkpoint.iteration)
            _read(progress, checkpoint.tensors["progress"], checkpoint.iteration)
        run.truncate_history(progress.iteration)

    def save(at: Progress) -> Path:
        assert run is not None
        tensors = {
            **problem.state(),
            "progress": torch.tensor([at.seconds, at.loss_sum, at.loss_count], dtype=torch.float64),
        }
        return save_checkpoint(run.checkpoints, at.iteration, tensors, run_hash)

    for event in optimize(problem, settings, progress, save if run else None, run.checkpoints if run else None):
        if isinstance(event, StepEvent) and run is not None:
            place = {"iteration": event.iteration, "seconds": round(event.seconds, 3), "loss": event.loss}
            run.append_history({**place, **event.state, **event.metrics})
        for callback in callbacks:
            callback(event)


def _read(progress: Progress, saved: Tensor, iteration: int) -> None:
    progress.iteration = iteration
    progress.seconds, progress.loss_sum, loss_count = saved.tolist()
    progress.loss_count = int(loss_count)
