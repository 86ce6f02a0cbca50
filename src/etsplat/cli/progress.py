"""What a terminal shows of a job: how it goes, with a live bar or now and then a line, and how a run ended."""

from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from etsplat.io.images import open_image
from etsplat.optim.loop import DoneEvent, Event, NoteEvent, PrepareEvent, StepEvent, UndoEvent

LINES = 10
"""Without a terminal, so many lines tell of the optimization."""

PICTURE_COLUMNS = 96

_FILES = (
    ("report.html", "everything on one page"),
    ("overview.png", "test views: truth, render, and as opaque triangles"),
    ("soup.safetensors", "the soup: etsplat view, render, export and eval take its folder"),
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
            speed_estimate_period=60,
            expand=True,
        )
        self._task: TaskID | None = None
        self._phase = ""

    def __enter__(self: B) -> B:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._progress.stop()

    def show(self, phase: str, done: int = 0, total: int = 0, state: str = "") -> None:
        """Say how far a phase is; `total` 0 if nobody knows. `state` stands beside the bar."""
        count = f"{done}/{total} eta" if total else ""
        if phase != self._phase or self._task is None:
            if self._task is not None:
                self._progress.remove_task(self._task)
            # A new task starts with what is done already, so that a resumed run's rate counts from here.
            self._task = self._progress.add_task(phase, total=total or None, completed=done, count=count, state=state)
            self._phase = phase
            if not self._console.is_terminal:
                print(phase, flush=True)
        self._progress.update(self._task, completed=done, total=total or None, count=count, state=state)


class RunProgress(PhaseBar):
    """A callback for a task, and the context in which its bar is alive."""

    def __init__(self, console: Console, *, preparing: str) -> None:
        super().__init__(console)
        self._preparing = preparing
        self._metrics: dict[str, float] = {}
        self._lines = 0

    def __call__(self, event: Event) -> None:
        """Take in an event of the run."""
        if isinstance(event, PrepareEvent):
            self.show(self._preparing, event.done, event.total)
        elif isinstance(event, NoteEvent | UndoEvent):
            self._console.print(f"  {event}", highlight=False, markup=False, soft_wrap=True)
        elif isinstance(event, StepEvent):
            self._step(event)
        elif isinstance(event, DoneEvent):
            self.show("Measuring the result")

    def _step(self, event: StepEvent) -> None:
        self._metrics |= event.metrics
        event = replace(event, metrics=self._metrics)  # the last that were measured
        self.show("Optimizing", event.iteration, event.iterations, event.summary)
        if not self._console.is_terminal and event.iteration * LINES >= self._lines * event.iterations:
            self._lines = event.iteration * LINES // event.iterations + 1
            print(f"  {event}", flush=True)


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
