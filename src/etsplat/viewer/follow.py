"""Keeps up with a run that is still going on, through its files alone."""

import time
from collections.abc import Callable
from pathlib import Path

import torch

from etsplat.core.errors import InputError
from etsplat.core.spelling import either
from etsplat.io.json_text import is_number
from etsplat.io.locks import was_killed
from etsplat.io.run_directory import RunDirectory, is_empty, is_run
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.opened_runs import check_trains

WAITING_SECONDS = 1.0


def wait_for_soup(folder: Path, announce: Callable[[str], None]) -> None:
    """Returns when the run in a folder has written its first soup: the folder may be empty, or not be there, as yet.

    Args:
        folder: of the run.
        announce: told once what is waited for, and again when that changes.

    Raises:
        InputError: the folder holds something else, or a run of an earlier version, or goes away.
    """
    if folder.is_dir() and not is_empty(folder) and not is_run(folder):
        a_run = either("a folder given to --out", "the folder of one")
        raise InputError(f"{folder}: is not a run of etsplat; name {a_run}, or a soup's file")
    told, seen = "", False
    while not RunDirectory(folder).soup_path.is_file():
        if seen and not folder.is_dir():
            raise InputError(f"{folder}: has gone; name another folder")
        seen = folder.is_dir()
        begun = is_run(folder)
        if begun:
            check_trains(folder)
        text = f"{folder}: waiting for " + ("the first checkpoint" if begun else "`etsplat train` to begin there")
        if begun and (end := RunDirectory(folder).read_end()):
            text = f"{folder}: {end}; waiting for it to go on"
        if text != told:
            announce(told := text)
        time.sleep(WAITING_SECONDS)
    RunDirectory(folder).read_iterations()  # as following it will


class Followed:
    """The soup of a run directory, read anew, onto a device, whenever its file changes."""

    def __init__(self, folder: Path, device: torch.device) -> None:
        self._run, self._device = RunDirectory(folder), device
        self._seen = self._stamp()

    def poll(self) -> TriangleSoup | None:
        """The new soup if there is one since the last call."""
        stamp = self._stamp()
        if stamp == self._seen:
            return None
        try:
            soup = TriangleSoup.load(self._run.soup_path).to(self._device)
        except InputError:  # the file went away in between: a run was started anew
            return None
        self._seen = stamp
        return soup

    def status(self) -> str:
        """How the run stands, in a line; empty before its first line of history, and where a file is missing."""
        try:
            history, iterations = self._run.read_history(), self._run.read_iterations()
        except InputError:  # between two runs, of which one replaces the other
            return ""
        if not history:
            return ""
        last = history[-1]
        known = [line["psnr"] for line in history if is_number(line.get("psnr"))]
        quality = f", {known[-1]:.2f} dB on test views" if known else ""
        reached = f"iteration {last['iteration']:,} of {iterations:,}{quality}"
        if self._run.metrics_path.is_file():
            return f"finished: {reached}"
        if end := self._run.read_end():
            return f"{end} (after {reached})"
        return f"killed (after {reached})" if was_killed(self._run.path) else f"running: {reached}"

    def _stamp(self) -> tuple[int, int] | None:
        try:
            found = self._run.soup_path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size
