"""The optimization loop: it drives a problem and yields events; it knows nothing about triangles.

`optimize` is the loop; `optim/drive.py` has that from the last checkpoint on, with a run's history.

Everything that happens at an iteration (step, refinement) is done before its events are yielded, so a consumer always
sees, and a checkpoint always holds, the state between two iterations.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torch import Tensor

from etsplat.core.validation import check_count
from etsplat.core.workers import workers
from etsplat.optim.camera_event import CamerasEvent
from etsplat.optim.checkpoints import list_checkpoints


class DivergedError(RuntimeError):
    """The loss or a parameter became NaN or infinite. The message is one line that says when and what is left.

    Example:
        >>> photos = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=3, supersampling=1)
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
        >>> broken = etsplat.Custom(lambda drawing: torch.log(-drawing.model.sigma))
        >>> try:
        ...     outcome = etsplat.Trainer(mesh, photos, etsplat.Objective(etsplat.Photometric(), [broken])).fit(5)
        ... except etsplat.DivergedError as error:
        ...     found = str(error)
        >>> "nan" in found
        True
    """


@dataclass(frozen=True)
class PrepareEvent:
    """While the input is made ready (pictures are taken of a mesh, photos are decoded), before the first step.

    Attributes:
        done: views done.
        total: views in all.

    Example:
        >>> event = etsplat.PrepareEvent(done=12, total=48)
        >>> f"{event.done / event.total:.0%}"
        '25%'
    """

    done: int
    total: int


@dataclass(frozen=True)
class StageEvent:
    """While the start of a run is made, or what belongs to its result beside what it optimizes.

    Attributes:
        name: what is made.
        done: steps done.
        total: steps in all; 0 where nobody knows.

    Example:
        >>> print(etsplat.StageEvent("texture", 40, 200))
        texture: 40/200
    """

    name: str
    done: int
    total: int

    def __str__(self) -> str:
        return f"{self.name}: {self.done}/{self.total}"


@dataclass(frozen=True)
class NoteEvent:
    """Something that the owner of the run should know, such as a repair made while reading the input.

    Attributes:
        text: a sentence.

    Example:
        What a run has to say before it begins:

        >>> def listen(event):
        ...     if isinstance(event, etsplat.NoteEvent):
        ...         print(event.text)
        >>> listen(etsplat.NoteEvent("source: 3 degenerate faces were left out"))
        source: 3 degenerate faces were left out
    """

    text: str

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class StepEvent:
    """Every `log_every` iterations, at every evaluation, and at the last iteration.

    Attributes:
        iteration: iterations done.
        iterations: length of the run.
        seconds: time spent optimising so far (steps and refinements), over all parts of a resumed run. Evaluation,
            checkpoints and callbacks are not in it.
        loss: mean over the iterations since the last event of this kind.
        state: what the problem says of itself, such as "faces" and "sigma".
        metrics: what was evaluated at this iteration ("psnr", "chamfer"), or empty.

    Example:
        >>> state, metrics = {"faces": 2500, "sigma": 0.25}, {"psnr": 28.5}
        >>> print(etsplat.StepEvent(100, 2000, seconds=4.2, loss=0.0312, state=state, metrics=metrics))
        100/2000 · 4 s · loss 0.0312 · 28.50 dB · 2,500 faces · σ 0.250
    """

    iteration: int
    iterations: int
    seconds: float
    loss: float
    state: dict[str, float]
    metrics: dict[str, float]

    @property
    def summary(self) -> str:
        """Loss, PSNR of test and watched photos if it was measured, number of triangles and softness."""
        parts = [f"loss {self.loss:.4f}"]
        parts += [f"{self.metrics['psnr']:.2f} dB"] if "psnr" in self.metrics else []
        parts += [f"watched {self.metrics['watched_psnr']:.2f} dB"] if "watched_psnr" in self.metrics else []
        parts += [f"{self.state[name]:,} {name}" for name in ("faces", "triangles") if name in self.state]
        parts += [f"σ {self.state['sigma']:.3f}"] if "sigma" in self.state else []
        return " · ".join(parts)

    def __str__(self) -> str:
        return f"{self.iteration}/{self.iterations} · {self.seconds:.0f} s · {self.summary}"


@dataclass(frozen=True)
class RefineEvent:
    """Primitives were added or removed after this iteration's step.

    Attributes:
        iteration: iterations done.
        count: number of primitives now.
        added: how many more than before; negative if there are fewer.

    Example:
        >>> print(etsplat.RefineEvent(iteration=300, count=5000, added=2500))
        300: 5,000 triangles (+2,500)
    """

    iteration: int
    count: int
    added: int

    def __str__(self) -> str:
        return f"{self.iteration}: {self.count:,} triangles ({self.added:+,})"


@dataclass(frozen=True)
class UndoEvent:
    """An edit was undone: photos were explained worse some steps later. The run is back where it was before the edit.

    What came after that iteration does not count any more, and comes again without the edit.

    Attributes:
        iteration: after whose step the edit had been made; so many are done now.
        judged: how many were done.
        loss_before: photometric loss of the training views before the edit.
        loss_after: the same when it was judged.
        milder: whether another edit is made in its place, which changes less.

    Example:
        >>> event = etsplat.UndoEvent(iteration=300, judged=340, loss_before=0.020, loss_after=0.025)
        >>> str(event).split(": ")[0], "25.0 % higher than before" in str(event)
        ('iteration 300', True)
    """

    iteration: int
    judged: int
    loss_before: float
    loss_after: float
    milder: bool = False

    def __str__(self) -> str:
        rise = 100 * (self.loss_after / self.loss_before - 1) if self.loss_before else math.inf
        return (
            f"iteration {self.iteration:,}: the edit of the triangles is undone: {self.judged - self.iteration} "
            f"steps after it the loss of the training photos was {rise:.1f} % higher than before; "
            f"{'a milder one is tried' if self.milder else 'the run goes on without'}"
        )


@dataclass(frozen=True)
class CheckpointEvent:
    """A checkpoint was written.

    Attributes:
        iteration: iterations done.
        path: the file.

    Example:
        >>> photos = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=3, supersampling=1)
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
        >>> events = []
        >>> trainer = etsplat.Trainer(mesh, photos, etsplat.Objective(etsplat.Photometric()))
        >>> outcome = trainer.fit(4, callbacks=[events.append], checkpoint_every=2, run="run")
        >>> [event.iteration for event in events if isinstance(event, etsplat.CheckpointEvent)]
        [2, 4]
    """

    iteration: int
    path: Path

    def __str__(self) -> str:
        return f"{self.iteration}: {self.path}"


@dataclass(frozen=True)
class DoneEvent:
    """All iterations are done; nothing is yielded after this.

    Attributes:
        iteration: iterations done.
        seconds: as in StepEvent.

    Example:
        >>> print(etsplat.DoneEvent(iteration=2000, seconds=81.4))
        2000 iterations in 81.4 s
    """

    iteration: int
    seconds: float

    def __str__(self) -> str:
        return f"{self.iteration} iterations in {self.seconds:.1f} s"


Return = UndoEvent | CamerasEvent
"""Of runs that may have gone back, and have changed otherwise than by a step or an edit."""

Event = PrepareEvent | StageEvent | NoteEvent | StepEvent | RefineEvent | Return | CheckpointEvent | DoneEvent
"""The first three are told by tasks, before the loop begins or after it ended."""

Callback = Callable[[Event], None]


class Problem(Protocol):
    """What the loop drives: parameters, their optimizer, and the data they are fitted to."""

    @property
    def count(self) -> int:
        """Number of primitives."""
        ...

    def describe(self) -> dict[str, float]:
        """A few numbers about the present state for the log, by name. Changes nothing."""
        ...

    def advance(self, first: int, last: int) -> list[float]:
        """Makes the optimizer steps of iteration `first` and of as many as it likes up to `last`.

        Nothing else is asked before, so steps on a device can follow each other without the host. It must not pass an
        iteration at which `refine` or `review` has something to do.

        Returns:
            The loss before each step made; one that is not finite ends them.
        """
        ...

    def refine(self, iteration: int) -> int:
        """Adds or removes primitives if this iteration is one for that; returns how many were added."""
        ...

    def review(self, progress: "Progress") -> Return | None:
        """Judges what was done earlier if it is time to. If it is undone, all, `progress` too, is as it was before."""
        ...

    def evaluate(self) -> dict[str, float]:
        """Cheap metrics of the present state. Changes nothing."""
        ...

    def first_not_finite(self) -> str | None:
        """The name of a parameter that holds NaN or infinity, or None."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        ...

    def load_state(self, state: dict[str, Tensor], iteration: int) -> None:
        """Continues where `state` was taken."""
        ...


@dataclass
class Progress:
    """Where a run stands; part of a checkpoint.

    Attributes:
        iteration: iterations done.
        seconds: time spent on them.
        loss_sum: sum of the losses since the last StepEvent.
        loss_count: how many.
        ending: whether the run is to end after the iteration at hand; no part of a checkpoint.
    """

    iteration: int = 0
    seconds: float = 0.0
    loss_sum: float = 0.0
    loss_count: int = 0
    ending: bool = False


@dataclass(frozen=True)
class LoopSettings:
    """When things happen.

    Attributes:
        iterations: length of the run, >= 0.
        log_every: iterations between StepEvents, >= 1.
        evaluate_every: iterations between evaluations; 0 for none before the last iteration, which always has one.
        checkpoint_every: iterations between checkpoints; 0 for none before the last iteration, which always has one.

    Raises:
        ValueError: one of them is out of its range, or no whole number.
    """

    iterations: int
    log_every: int
    evaluate_every: int
    checkpoint_every: int

    def __post_init__(self) -> None:
        for name, least in (("iterations", 0), ("log_every", 1), ("evaluate_every", 0), ("checkpoint_every", 0)):
            object.__setattr__(self, name, check_count(name, getattr(self, name), least=least))


def optimize(
    problem: Problem,
    settings: LoopSettings,
    progress: Progress,
    save: Callable[[Progress], Path] | None,
    folder: Path | None,
) -> Iterator[Event]:
    """Runs `problem` from `progress` to the last iteration.

    Ctrl-C finishes the iteration at hand, saves a checkpoint, and then raises KeyboardInterrupt, on all workers where
    one was interrupted; a second Ctrl-C raises at once. `progress.ending` ends it likewise, without an exception.

    Args:
        problem: what to optimise; changed in place.
        settings: when things happen.
        progress: where the run stands; changed in place.
        save: writes a checkpoint and returns its path; None where nothing is kept.
        folder: of the checkpoints, named in the error of a diverged run; None where there is none.

    Yields:
        Events in the order of `Event`; of one iteration, those that apply.

    Raises:
        DivergedError: the loss or a parameter is not finite.
        KeyboardInterrupt: after Ctrl-C.
    """
    progress.ending = ending = False
    with _deferred_interrupt() as interrupted:
        while progress.iteration < settings.iterations and not ending:
            added, undone = _advance(problem, progress, _next_stop(settings, progress.iteration), folder)
            iteration = progress.iteration
            last = iteration == settings.iterations
            evaluating = last or _due(iteration, settings.evaluate_every)
            logging = evaluating or _due(iteration, settings.log_every)
            saving = last or undone is not None or _due(iteration, settings.checkpoint_every)
            if logging or saving:
                _check_finite(problem, iteration, folder)
            if undone is not None:
                yield undone
            if logging:
                yield _step_event(problem, settings, progress, problem.evaluate() if evaluating else {})
            if added:
                yield RefineEvent(iteration, problem.count, added)
            ending = workers().any(interrupted() or progress.ending)  # by whoever was told of the above, too
            if save is not None and (saving or ending):
                if not (logging or saving):
                    _check_finite(problem, iteration, folder)
                yield CheckpointEvent(iteration, save(progress))
        if workers().any(interrupted()):
            raise KeyboardInterrupt
    yield DoneEvent(progress.iteration, progress.seconds)


def _check_finite(problem: Problem, iteration: int, folder: Path | None) -> None:
    if name := problem.first_not_finite():
        raise DivergedError(f"{name} is not finite at iteration {iteration}; {_what_is_left(folder)}")


def _advance(problem: Problem, progress: Progress, stop: int, folder: Path | None) -> tuple[int, Return | None]:
    """Steps and edits; returns how many triangles were added, and what was undone."""
    start = time.perf_counter()
    for loss in problem.advance(progress.iteration + 1, stop):
        progress.iteration += 1
        if not math.isfinite(loss):
            raise DivergedError(f"the loss is {loss} at iteration {progress.iteration}; {_what_is_left(folder)}")
        progress.loss_sum += loss
        progress.loss_count += 1
    added, undone = 0, problem.review(progress)
    if undone is None:
        added = problem.refine(progress.iteration)
        undone = problem.review(progress)  # of an edit that no step follows
    progress.seconds += time.perf_counter() - start
    return (0 if undone else added), undone


def _next_stop(settings: LoopSettings, iteration: int) -> int:
    """The next iteration after which something is logged, evaluated or saved."""
    every = (settings.log_every, settings.evaluate_every, settings.checkpoint_every)
    return min(settings.iterations, *((iteration // n + 1) * n for n in every if n > 0))


def _step_event(problem: Problem, settings: LoopSettings, progress: Progress, metrics: dict[str, float]) -> StepEvent:
    loss = progress.loss_sum / progress.loss_count
    progress.loss_sum, progress.loss_count = 0.0, 0
    return StepEvent(
        iteration=progress.iteration,
        iterations=settings.iterations,
        seconds=progress.seconds,
        loss=loss,
        state=problem.describe(),
        metrics=metrics,
    )


def _due(iteration: int, every: int) -> bool:
    return every > 0 and iteration % every == 0


def _what_is_left(folder: Path | None) -> str:
    saved = [] if folder is None else list_checkpoints(folder)
    if not saved:
        return "no checkpoint was written yet; lower the learning rates and start again"
    return f"the last good checkpoint is {saved[-1]}; lower the learning rates and start again in another folder"


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Within the block the first Ctrl-C only sets what the yielded function returns; a second one raises as usual.

    An exception in the middle of a step would leave parameters and moments of different iterations, from which a
    resumed run could not end with the same bits. Outside the main thread Python delivers no signals, so there is
    nothing to do.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    pressed = threading.Event()
    previous = signal.getsignal(signal.SIGINT) or signal.default_int_handler

    def on_interrupt(*_: object) -> None:
        pressed.set()
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, previous)
