"""Shows how a job of several phases goes: a live bar on a terminal, a line for each phase elsewhere."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn


class PhaseBar:
    """A context in which `show` may be called, from any thread."""

    def __init__(self, console: Console) -> None:
        self._console = console
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

    def __enter__(self) -> "PhaseBar":
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._progress.stop()

    def show(self, phase: str, done: int, total: int, state: str = "") -> None:
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
