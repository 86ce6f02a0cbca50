"""What a log says of a run: how far it is, and how long it will still take."""

import io

import pytest
from rich.console import Console

from etsplat.cli import progress
from etsplat.cli.progress import PhaseBar, RunProgress
from etsplat.optim.loop import StepEvent


def step(iteration: int, iterations: int) -> StepEvent:
    return StepEvent(iteration, iterations, 2.0 * iteration, 0.0312, {"triangles": 41_000}, {})


def lines_of(
    steps: list[int],
    seconds: float,
    iterations: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> list[str]:
    """Of a run whose steps take so long, told of at some of them, without a terminal."""
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with RunProgress(Console(file=io.StringIO()), preparing="Reading the photos") as told:
        for before, iteration in zip([0, *steps], steps, strict=False):
            now[0] += seconds * (iteration - before)
            told(step(iteration, iterations))
    return capsys.readouterr().out.splitlines()


def test_lines_of_a_log_say_how_long_it_will_take(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As soon as there is a pace, until the last iteration, a line for each tenth of the run."""
    lines = lines_of(list(range(10, 1001, 10)), 0.1, 1000, monkeypatch, capsys)
    assert lines[0] == "Optimizing"
    assert lines[1] == "  10/1000 · 20 s · loss 0.0312 · 41,000 triangles"
    assert lines[3] == "  200/1000 · 400 s · loss 0.0312 · 41,000 triangles · 1:20 left"
    assert lines[-1] == "  1000/1000 · 2000 s · loss 0.0312 · 41,000 triangles"
    assert len(lines) == 12


def test_a_slow_run_is_told_of_every_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where its steps are told of every few minutes only."""
    lines = lines_of([1, 50, 100, 150], 2.0, 6000, monkeypatch, capsys)
    assert [line.split("/")[0].strip() for line in lines[1:]] == ["1", "50", "100", "150"]
    assert lines[4].endswith("3:15:00 left")


def test_on_a_terminal_the_bar_says_it(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The same time, from the same pace; no lines."""
    now, screen = [1000.0], io.StringIO()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with RunProgress(Console(file=screen, force_terminal=True, width=150), preparing="") as told:
        for iteration in (10, 20, 30, 40):
            now[0] += 1.0
            told(step(iteration, 1000))
        assert told.left == "1:36"
        told._progress.refresh()
    assert "01:36" in screen.getvalue()
    assert "iterations" not in capsys.readouterr().out


def test_lines_of_a_log_say_how_far_a_phase_is_where_it_takes_long(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line for each tenth, with the time that is left; of a phase of a second, or without an end, its name alone."""
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with PhaseBar(Console(file=io.StringIO())) as bar:
        for phase, seconds in (("Finding features", 1.0), ("Comparing photos", 0.001)):
            for done in range(101):
                now[0] += seconds
                bar.show(phase, done, 100)
        bar.show("Placing all cameras at once")
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if not line.startswith(" ")] == [
        "Finding features",
        "Comparing photos",
        "Placing all cameras at once",
    ]
    assert lines[1] == "  5/100 · 1:35 left"
    assert lines[2] == "  10/100 · 1:30 left"
    assert lines[11] == "  100/100"
    assert len(lines) == 14
