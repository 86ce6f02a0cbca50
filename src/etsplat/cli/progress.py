"""What a terminal shows of a job: how it goes, with a live bar or now and then a line, and how a run ended."""

import time
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from etsplat.io.images import open_image
from etsplat.optim.loop import DoneEvent, Event, NoteEvent, PrepareEvent, Return, StageEvent, StepEvent

LINES, LINE_SECONDS = 10, 60.0
"""Without a terminal, so many lines tell of a phase, and more where they come less often than that."""

_CALM_SECONDS = 5.0
"""Of phases that say how far they are and nothing else, lines come no more often: short ones need none."""

_PACE_SECONDS = 600.0
"""For how long back the pace is measured: slow runs tell of themselves every few minutes."""

PICTURE_COLUMNS = 96

_FILES = (
    ("report.html", "everything on one page"),
    ("overview.png", "test views: truth, render, and as opaque triangles"),
    (
        "opaque.glb",
        "the scene as opaque triangles, for mesh viewers; etsplat export writes other kinds",
    ),
    ("soup.safetensors", "the soup: etsplat view, render, export and eval take its folder"),
    ("textured.glb", "few faces under a texture, for game engines and the web"),
    ("mesh.glb", "the mesh for viewers (also mesh.obj and mesh.ply)"),
    ("metrics.json", "the numbers above and more"),
)

B = TypeVar("B", bound="PhaseBar")


class PhaseBar:
    """A context in which `show` may be called, from any thread."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console = console or Console()
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[count]}"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[state]}"),
            console=console,
            disable=not console.is_terminal,
            speed_estimate_period=_PACE_SECONDS,
            get_time=lambda: time.monotonic(),
            expand=True,
        )
        self._task: TaskID | None = None
        self._phase = ""
        self._lines, self._told = 0, 0.0

    def __enter__(self: B) -> B:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._progress.stop()

    def show(self, phase: str, done: int = 0, total: int = 0, state: str = "", line: str = "") -> None:
        """Say how far a phase is; `total` 0 if nobody knows. `state` stands beside the bar, `line` in a log."""
        count = f"{done}/{total} eta" if total else ""
        if phase != self._phase or self._task is None:
            if self._task is not None:
                self._progress.remove_task(self._task)
            # A new task starts with what is done already, so that a resumed run's rate counts from here.
            self._task = self._progress.add_task(phase, total=total or None, completed=done, count=count, state=state)
            self._phase = phase
            self._lines, self._told = 0, time.monotonic() if not line else 0.0
            if not self._console.is_terminal:
                print(phase, flush=True)
        self._progress.update(self._task, completed=done, total=total or None, count=count, state=state)
        if not self._console.is_terminal and 0 < done <= total:
            self._tell(done, total, line)

    def _tell(self, done: int, total: int, line: str) -> None:
        """A line for a log, if it is time for one."""
        now = time.monotonic()
        pause = now - self._told
        if pause >= LINE_SECONDS or (done * LINES >= self._lines * total and (line or pause >= _CALM_SECONDS)):
            self._lines, self._told = done * LINES // total + 1, now
            unfinished = self.left if done < total else ""
            print(f"  {line or f'{done}/{total}'}{f' · {unfinished} left' if unfinished else ''}", flush=True)

    @property
    def left(self) -> str:
        """How long the phase will still take, as the bar has it: 3:20 or 1:03:20; empty while nobody knows."""
        seconds = None if self._task is None else self._progress.tasks[-1].time_remaining
        if seconds is None:
            return ""
        minutes, rest = divmod(round(seconds), 60)
        hours, minutes = divmod(minutes, 60)
        return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class RunProgress(PhaseBar):
    """A callback for a task, and the context in which its bar is alive."""

    def __init__(self, console: Console, *, preparing: str) -> None:
        super().__init__(console)
        self._preparing = preparing
        self._metrics: dict[str, float] = {}

    def __call__(self, event: Event) -> None:
        """Take in an event of the run."""
        if isinstance(event, PrepareEvent):
            self.show(self._preparing, event.done, event.total)
        elif isinstance(event, StageEvent):
            self.show(event.name, event.done, event.total)
        elif isinstance(event, NoteEvent | Return):
            self._console.print(f"  {event}", highlight=False, markup=False, soft_wrap=True)
        elif isinstance(event, StepEvent):
            self._step(event)
        elif isinstance(event, DoneEvent):
            self.show("Measuring the result")

    def _step(self, event: StepEvent) -> None:
        self._metrics |= event.metrics
        event = replace(event, metrics=self._metrics)  # the last that were measured
        self.show("Optimizing", event.iteration, event.iterations, event.summary, str(event))


def print_summary(console: Console, run_dir: Path) -> None:
    """Print how a run in `run_dir` ended."""
    from etsplat.report.cards import cards_of  # late: matplotlib takes a while
    from etsplat.report.data import read_run

    run = read_run(run_dir)
    if console.is_terminal and console.color_system == "truecolor" and (run_dir / "overview.png").is_file():
        with open_image(run_dir / "overview.png") as image:
            console.print(half_blocks(image, min(PICTURE_COLUMNS, console.width)))
    metrics = Table(box=None, show_header=False, pad_edge=False)
    for metric in cards_of(run):
        unit = metric.unit if metric.value is not None else "not measured; report.html says why"
        metrics.add_row(metric.title, Text(metric.value or "-", justify="right"), Text(unit))
    console.print(metrics)
    console.print()
    for name, meaning in _FILES:
        if (run_dir / name).is_file():
            console.print(Text(f"{run_dir / name}").append(f"  {meaning}", style="dim"), soft_wrap=True)
    if run.verdict is not None:
        console.print(Text(f"The result is {run.verdict}."), soft_wrap=True)


def half_blocks(image: Image.Image, columns: int) -> Text:
    """The image in characters: each is an upper half block, two pixels above each other in two colours."""
    rows = max(1, round(image.height * columns / image.width / 2))
    pixels = image.convert("RGB").resize((columns, 2 * rows), Image.Resampling.BOX).tobytes()
    text = Text()
    for row in range(rows):
        for column in range(columns):
            upper, lower = (3 * ((2 * row + half) * columns + column) for half in (0, 1))
            style = f"#{pixels[upper : upper + 3].hex()} on #{pixels[lower : lower + 3].hex()}"
            text.append("▀", style=style)
        text.append("\n")
    return text
