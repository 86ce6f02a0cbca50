"""A soup while it is trained, from the memory of the process that trains it."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from etsplat.data.dataset import Dataset
from etsplat.io.json_text import is_number
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import Event, StepEvent
from etsplat.tasks.opened_runs import SoupRun
from etsplat.tasks.running import end_of
from etsplat.viewer.server import Viewer, check_can_serve

LEAST_SECONDS = 1.0
"""Between two soups that are handed over."""

SHARE, DRAWING_SHARE = 0.01, 0.05
"""Of the time of training: what copying soups takes at most, and what drawing a new one takes for who only watches."""

_PARTING_SECONDS = 1.0
"""For which browsers are told how the run ended, before the process does."""


class LiveView:
    """A viewer of a run that is going on in this process: a callback of its events, and `look`, which gets the soups.

    In a context it says how the run ended, and ends the server. Nothing here changes what is trained: soups are copies,
    and they are drawn on the CPU by other threads, which use no random numbers.
    """

    def __init__(self, path: Path, host: str, port: int, width: int, announce: Callable[[int], None]) -> None:
        """Serves nothing yet.

        Args:
            path: the run directory.
            host: address to listen on.
            port: to listen on; the next free one is taken if it is in use.
            width: of still pictures, at most.
            announce: told the port when the page is there.

        Raises:
            InputError: viser is missing, or the address cannot be used.
        """
        check_can_serve(host, port)
        self._path, self._host, self._port, self._width, self._announce = path, host, port, width, announce
        self._viewer: Viewer | None = None
        self._due = 0.0
        self._progress = self._quality = ""

    def __call__(self, event: Event) -> None:
        """Takes in an event of the run."""
        if isinstance(event, StepEvent):
            if is_number(event.metrics.get("psnr")):
                self._quality = f", {event.metrics['psnr']:.2f} dB on test views"
            self._progress = f"iteration {event.iteration:,} of {event.iterations:,}"
            self.say(f"running: {self._progress}{self._quality}")

    def look(self, capture: Dataset, iteration: int, soup: Callable[[], TriangleSoup]) -> None:
        """Takes a copy of the soup if somebody watches and it is time for another; the first one in any case.

        Args:
            capture: in its own units.
            iteration: iterations done.
            soup: gives the copy, in the capture's units, on the CPU.
        """
        start = time.monotonic()
        if self._viewer is None:
            run = SoupRun(self._path, soup(), capture)
            self._viewer = Viewer(run, self._host, self._port, self._width, follow=False)
            self._announce(self._viewer.port)
            self.say(f"running: iteration {iteration:,}")
        elif start >= self._due and self._viewer.watched:
            self._viewer.show(soup())
            taken = time.monotonic() - start
            drawing = self._viewer.seconds_to_draw
            self._due = start + max(LEAST_SECONDS, taken / SHARE, drawing / DRAWING_SHARE)

    def say(self, text: str) -> None:
        """Says how the run stands, once there is a page."""
        if self._viewer is not None:
            self._viewer.say(text)

    def finish(self, soup: TriangleSoup) -> None:
        """Shows the result and says that the run is done."""
        if self._viewer is not None:
            self._viewer.show(soup)
        self.say(f"finished: {self._progress}{self._quality}")

    def stay(self, tell: Callable[[str], None]) -> None:
        """Goes on serving while a browser looks."""
        if self._viewer is not None and self._viewer.watched:
            tell("The viewer stays open while a browser looks (Ctrl-C ends it)")
            with contextlib.suppress(KeyboardInterrupt):
                while self._viewer.watched:
                    time.sleep(0.2)

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._viewer is None:
            return
        if error is not None:
            self.say(f"{end_of(error)} (after {self._progress or 'no iteration'}{self._quality})")
            if self._viewer.watched:
                self._viewer.server.flush()
                time.sleep(_PARTING_SECONDS)
        self._viewer.close()
