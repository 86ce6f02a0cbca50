"""The loop from the last checkpoint on, with checkpoints and the history of a run."""

import hashlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.spelling import either
from etsplat.core.workers import about_this, workers
from etsplat.io.locks import writing_run
from etsplat.io.paths import given_path
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.optim.camera_event import CamerasEvent
from etsplat.optim.checkpoints import Checkpoint, checkpoint_path, load_latest_checkpoint, save_checkpoint
from etsplat.optim.loop import Callback, Event, LoopSettings, Problem, Progress, StepEvent, UndoEvent, optimize


@contextmanager
def kept_in(run: RunDirectory | Path | str | None, settings: LoopSettings) -> Iterator[RunDirectory | None]:
    """Within the block the folder of a run is there, and locked where this worker is the one that writes it.

    Args:
        run: a path is one of a run or becomes one; a `RunDirectory` has been made and locked by the caller.
        settings: of the loop.

    Raises:
        InputError: it is no path, or of something else; somebody else writes the run.
    """
    if run is None or isinstance(run, RunDirectory):
        yield run
        return
    folder = given_path("run", run)
    if not workers().leads:
        yield RunDirectory(folder)
        return
    with writing_run(folder, warnings.warn):
        record = {"task": "fit", "iterations": settings.iterations}
        yield RunDirectory(folder) if is_run(folder) else RunDirectory.create(folder, record)


def drive(
    problem: Problem,
    progress: Progress,
    settings: LoopSettings,
    callbacks: Sequence[Callback],
    run: RunDirectory | None,
    run_hash: str,
    going_on: Callable[[int, int], None] = lambda iteration, iterations: None,
) -> None:
    """Runs the loop to the last iteration; on several workers with the same state on all. The first one keeps the run.

    Args:
        problem: changed in place.
        progress: where it stands; changed in place. A checkpoint in `run` takes its place.
        settings: when things happen.
        callbacks: each is called with every event.
        run: gets checkpoints and history.jsonl; None writes nothing.
        run_hash: identifies all that the result depends on.
        going_on: called with the iteration of a checkpoint that is gone on from, and the last one.

    Raises:
        DivergedError: a loss or parameter is not finite.
        InputError: the checkpoint is damaged, of another run or another version; the disk is full.
    """
    group = workers()
    if run is not None:
        checkpoint = group.from_first(lambda: load_latest_checkpoint(run.checkpoints, run_hash))
        if checkpoint is not None:
            _go_on(problem, progress, checkpoint)
            going_on(progress.iteration, settings.iterations)
        del checkpoint  # or its tensors would stay beside those that edits make of them
        if group.leads:
            run.truncate_history(progress.iteration)
    _check_same(problem, {**about_this(), "length of the run": settings.iterations, "settings": (settings, run_hash)})

    def save(at: Progress) -> Path:
        assert run is not None
        if not group.leads:
            return checkpoint_path(run.checkpoints, at.iteration)
        place = torch.tensor([at.seconds, at.loss_sum, at.loss_count], dtype=torch.float64)
        return save_checkpoint(run.checkpoints, at.iteration, {**problem.state(), "progress": place}, run_hash)

    told = callbacks if run is None or not group.leads else [History(run), *callbacks]
    for event in optimize(problem, settings, progress, save if run else None, run.checkpoints if run else None):
        if isinstance(event, StepEvent):
            _check_same(problem, {"iteration": event.iteration})
        for callback in told:
            callback(event)


def _go_on(problem: Problem, progress: Progress, checkpoint: Checkpoint) -> None:
    """Where a checkpoint was taken. InputError where it lacks something: versions before knew no such part."""
    try:
        problem.load_state(checkpoint.tensors, checkpoint.iteration)
        progress.seconds, progress.loss_sum, loss_count = checkpoint.tensors["progress"].tolist()
    except KeyError as error:
        anew = either(", with --overwrite or", "")  # which `Trainer.fit` has not
        raise InputError(
            f"{checkpoint.path}: another version of etsplat wrote it, it lacks `{error.args[0]}`; finish the run with "
            f"that version, or start it again{anew} in another folder"
        ) from error
    progress.iteration, progress.loss_count = checkpoint.iteration, int(loss_count)


def _check_same(problem: Problem, about: Mapping[str, object]) -> None:
    """Raises InputError on all workers where these values, or the states, are not the same on all."""
    if workers().count > 1:
        workers().agree({**about, "state of the run": digest_of(problem.state())})


def digest_of(tensors: Mapping[str, Tensor]) -> str:
    """Names the bits of tensors, and what these are called."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


class History:
    """Writes a line for each StepEvent and each UndoEvent; what is said of one iteration is one line."""

    def __init__(self, run: RunDirectory) -> None:
        """Takes whose history it is."""
        self._run = run
        self._undone: dict[str, Any] = {}

    def __call__(self, event: Event) -> None:
        """Takes in an event."""
        if isinstance(event, StepEvent):
            line = {"iteration": event.iteration, "seconds": round(event.seconds, 3), "loss": event.loss}
            line |= {**event.state, **event.metrics}
            if event.iteration == self._undone.get("iteration"):
                self._run.truncate_history(event.iteration - 1)
                line |= self._undone
            self._run.append_history(line)
        elif isinstance(event, UndoEvent):
            self._run.truncate_history(event.iteration - 1)
            losses = {"loss_before": event.loss_before, "loss_after": event.loss_after}
            self._undone = {"iteration": event.iteration, "undone": {"judged": event.judged, **losses}}
            self._run.append_history(self._undone)
        elif isinstance(event, CamerasEvent) and event.forgets:
            self._run.truncate_history(event.begin - (event.refined is None))  # whose line comes again
