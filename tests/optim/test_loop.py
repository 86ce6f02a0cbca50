"""The loop: which events come when, what stops it, and that it stops only between iterations."""

import math
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from etsplat.optim.loop import (
    CheckpointEvent,
    DivergedError,
    DoneEvent,
    Event,
    LoopSettings,
    Progress,
    RefineEvent,
    StepEvent,
    UndoEvent,
    optimize,
)

SETTINGS = LoopSettings(iterations=10, log_every=4, evaluate_every=5, checkpoint_every=6)


class Counting:
    """A problem whose loss is the iteration; it refines at iteration 3, and makes up to `at_a_time` steps together."""

    def __init__(self, at_a_time: int = 1) -> None:
        self.count = 20
        self.done: list[str] = []
        self.finite = True
        self.on_step: Callable[[int], float] = float
        self.at_a_time = at_a_time

    def advance(self, first: int, last: int) -> list[float]:
        last = min(last, first + self.at_a_time - 1)
        if first <= 3:
            last = min(last, 3)
        self.done.append(f"step {first}" if first == last else f"steps {first} to {last}")
        return [self.on_step(iteration) for iteration in range(first, last + 1)]

    def refine(self, iteration: int) -> int:
        self.done.append(f"refine {iteration}")
        added = 10 if iteration == 3 else 0
        self.count += added
        return added

    def review(self, progress: Progress) -> UndoEvent | None:
        return None

    def evaluate(self) -> dict[str, float]:
        return {"psnr": 30.0}

    def describe(self) -> dict[str, float]:
        return {"faces": self.count}

    def first_not_finite(self) -> str | None:
        return None if self.finite else "colors"


def events_of(problem: Counting, folder: Path, progress: Progress | None = None) -> list[Event]:
    return list(optimize(problem, SETTINGS, progress or Progress(), lambda _: folder / "file", folder))


def test_events_come_when_the_settings_say(tmp_path: Path) -> None:
    """Logs at 4, 8; evaluations, also logged, at 5 and the end; a refinement at 3; checkpoints at 6 and the end."""
    events = events_of(Counting(), tmp_path)
    at = {kind: [e.iteration for e in events if isinstance(e, kind)] for kind in {type(e) for e in events}}
    assert at == {
        StepEvent: [4, 5, 8, 10],
        RefineEvent: [3],
        CheckpointEvent: [6, 10],
        DoneEvent: [10],
    }
    assert isinstance(events[-1], DoneEvent)


def test_the_logged_loss_is_the_mean_since_the_last_log(tmp_path: Path) -> None:
    """With loss = iteration: mean of 1..4, of 5, of 6..8, of 9..10."""
    steps = [event for event in events_of(Counting(), tmp_path) if isinstance(event, StepEvent)]
    assert [event.loss for event in steps] == [2.5, 5.0, 7.0, 9.5]
    assert [event.state["faces"] for event in steps] == [30] * 4
    assert [event.metrics for event in steps] == [{}, {"psnr": 30.0}, {}, {"psnr": 30.0}]


def test_steps_made_together_yield_the_same_events(tmp_path: Path) -> None:
    """Steps on a device run on up to the next iteration with a refinement, log, evaluation or checkpoint."""
    problem = Counting(at_a_time=100)
    events = [replace(e, seconds=0) for e in events_of(problem, tmp_path) if hasattr(e, "seconds")]
    assert events == [replace(e, seconds=0) for e in events_of(Counting(), tmp_path) if hasattr(e, "seconds")]
    steps = [done for done in problem.done if done.startswith("step")]
    assert steps == ["steps 1 to 3", "step 4", "step 5", "step 6", "steps 7 to 8", "steps 9 to 10"]


def test_a_loss_among_many_is_named_by_its_iteration(tmp_path: Path) -> None:
    """Of the steps 7 and 8, made together, the second has a loss that is not finite."""
    problem = Counting(at_a_time=100)
    problem.on_step = lambda iteration: math.nan if iteration == 8 else 1.0
    with pytest.raises(DivergedError, match="the loss is nan at iteration 8"):
        events_of(problem, tmp_path)


def test_a_continued_loop_yields_the_rest(tmp_path: Path) -> None:
    """From the progress saved at iteration 6 on, losses and events are those of the whole run."""
    whole = [e for e in events_of(Counting(), tmp_path) if isinstance(e, StepEvent)]
    rest = [e for e in events_of(Counting(), tmp_path, Progress(6, 1.0, 6.0, 1)) if isinstance(e, StepEvent)]
    assert [(e.iteration, e.loss) for e in rest] == [(e.iteration, e.loss) for e in whole[2:]]
    assert rest[0].seconds > 1.0


@pytest.mark.parametrize("loss", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_the_run(tmp_path: Path, loss: float) -> None:
    """The error is one line with the iteration and the last good checkpoint."""
    (tmp_path / "step_000006.safetensors").touch()
    problem = Counting()
    problem.on_step = lambda iteration: loss if iteration == 7 else 1.0
    with pytest.raises(DivergedError) as error:
        events_of(problem, tmp_path)
    assert "\n" not in str(error.value)
    assert "iteration 7" in str(error.value)
    assert "step_000006.safetensors" in str(error.value)


def test_a_parameter_that_is_not_finite_never_reaches_a_checkpoint(tmp_path: Path) -> None:
    """Parameters are looked at before a log or a checkpoint; without an earlier checkpoint the error says so."""
    problem = Counting()
    problem.finite = False
    saved: list[int] = []
    with pytest.raises(DivergedError, match=r"iteration 4; no checkpoint"):
        for _ in optimize(problem, SETTINGS, Progress(), lambda p: saved.append(p.iteration) or tmp_path, tmp_path):
            pass
    assert saved == []


def test_ctrl_c_finishes_the_iteration_and_leaves_a_checkpoint(tmp_path: Path) -> None:
    """An interrupt in the middle of step 2 ends after refine 2, with a checkpoint of iteration 2."""
    problem = Counting()

    def press(iteration: int) -> float:
        if iteration == 2:
            signal.raise_signal(signal.SIGINT)
        return 1.0

    problem.on_step = press
    saved: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        for _ in optimize(problem, SETTINGS, Progress(), lambda p: saved.append(p.iteration) or tmp_path, tmp_path):
            pass
    assert problem.done[-1] == "refine 2"
    assert saved == [2]
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_during_the_last_iteration_is_not_lost(tmp_path: Path) -> None:
    """An interrupt in a callback after the last step still raises, after the last checkpoint."""
    seen: list[Event] = []

    def watch() -> None:
        for event in optimize(Counting(), SETTINGS, Progress(), lambda _: tmp_path, tmp_path):
            seen.append(event)
            if isinstance(event, CheckpointEvent) and event.iteration == 10:
                signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        watch()
    assert isinstance(seen[-1], CheckpointEvent)
