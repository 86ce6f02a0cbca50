"""Shows how a run goes: a live bar on a terminal, now and then a line elsewhere."""

from dataclasses import replace
from types import TracebackType

from rich.console import Console

from etsplat.cli.phases import PhaseBar
from etsplat.optim.loop import DoneEvent, Event, StepEvent
from etsplat.tasks.running import NoteEvent, PrepareEvent

LINES = 10
"""Without a terminal, so many lines tell of the optimization."""


class RunProgress:
    """A callback for a task, and the context in which its bar is alive."""

    def __init__(self, console: Console, *, preparing: str) -> None:
        self._console = console
        self._preparing = preparing
        self._bar = PhaseBar(console)
        self._metrics: dict[str, float] = {}
        self._lines = 0

    def __enter__(self) -> "RunProgress":
        self._bar.__enter__()
        self.say("Reading the input")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, traceback)

    def __call__(self, event: Event | PrepareEvent | NoteEvent) -> None:
        """Take in an event of the run."""
        if isinstance(event, PrepareEvent):
            self._bar.show(self._preparing, event.done, event.total)
        elif isinstance(event, NoteEvent):
            self._console.print(f"  {event.text}", highlight=False, markup=False, soft_wrap=True)
        elif isinstance(event, StepEvent):
            self._step(event)
        elif isinstance(event, DoneEvent):
            self.say("Measuring the result")

    def say(self, phase: str) -> None:
        """Enter a phase of unknown length."""
        self._bar.show(phase, 0, 0)

    def _step(self, event: StepEvent) -> None:
        self._metrics |= event.metrics
        event = replace(event, metrics=self._metrics)  # the last that were measured
        self._bar.show("Optimizing", event.iteration, event.iterations, event.summary)
        if not self._console.is_terminal and event.iteration * LINES >= self._lines * event.iterations:
            self._lines = event.iteration * LINES // event.iterations + 1
            print(f"  {event}", flush=True)
