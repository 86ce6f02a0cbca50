"""Runs in a notebook: a line that says how one goes, and how its result is shown."""

import base64
import importlib
import io
import sys
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from etsplat.io.overview import draw_overview, find_test_views
from etsplat.io.run_directory import RunDirectory
from etsplat.optim.loop import Callback, DoneEvent, Event, NoteEvent, PrepareEvent, Return, StageEvent, StepEvent

_SHOWN = (
    ("psnr", "PSNR", "{:.2f} dB"),
    ("chamfer", "Chamfer distance", "{:.3g}"),
    ("faces", "faces", "{:,}"),
    ("triangles", "triangles", "{:,}"),
    ("seconds", "time", "{:.1f} s"),
)
"""Metrics that a result is shown with, where they were measured: key, title, format."""


class NotebookProgress:
    """A callback that keeps one line under the cell."""

    def __init__(self) -> None:
        self._display = importlib.import_module("IPython.display").display
        self._line: Any = None

    def __call__(self, event: Event) -> None:
        """Takes in an event of the run."""
        if isinstance(event, NoteEvent | Return):
            print(event)
        elif isinstance(event, PrepareEvent):
            self._show(f"preparing the pictures: {event.done}/{event.total}")
        elif isinstance(event, StageEvent | StepEvent | DoneEvent):
            self._show(str(event))

    def _show(self, text: str) -> None:
        shown = {"text/plain": text}
        if self._line is None:
            self._line = self._display(shown, raw=True, display_id=True)
        else:
            self._line.update(shown, raw=True)


def notebook_callbacks() -> list[Callback]:
    """One that shows how a run goes where this runs in a notebook, none elsewhere."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return [NotebookProgress()] if hasattr(shell, "kernel") else []


def result_html(path: Path, metrics: Mapping[str, Any], opaque: str) -> str:
    """What a notebook shows of a result: test views, if it has any, the most telling metrics, and where it is.

    Args:
        path: the run directory.
        metrics: as in metrics.json.
        opaque: what the pictures of opaque triangles are called (`Model.OPAQUE`).
    """
    found = [f"{title} {form.format(metrics[key])}" for key, title, form in _SHOWN if metrics.get(key) is not None]
    said = f"The result is {metrics['judgement']['verdict']}." if "judgement" in metrics else ""
    lines = [escape(line) for line in (" · ".join(found), said) if line]
    caption = f"<p>{'<br>'.join(lines)}<br><code>{escape(str(path))}</code></p>"
    views = find_test_views(RunDirectory(path).test, opaque)
    if not views:
        return caption
    sheet = io.BytesIO()
    draw_overview(views, opaque).save(sheet, "PNG")
    picture = base64.b64encode(sheet.getvalue()).decode("ascii")
    title = f"Test views: truth, render, {opaque}"
    return f'<img src="data:image/png;base64,{picture}" alt="{escape(title)}" style="max-width: 100%">{caption}'
