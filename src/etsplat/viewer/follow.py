"""Keeps up with a run that is still going on, through its files alone."""

from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory
from etsplat.scene.soup_files import SoupFile, load_soup


class Followed:
    """The soup of a run directory, read anew whenever its file changes."""

    def __init__(self, folder: Path) -> None:
        self._run = RunDirectory(folder)
        self._seen = self._stamp()

    def poll(self) -> SoupFile | None:
        """The new soup if there is one since the last call."""
        stamp = self._stamp()
        if stamp == self._seen:
            return None
        try:
            file = load_soup(self._run.soup_path)
        except InputError:  # the file went away in between: a run was started anew
            return None
        self._seen = stamp
        return file

    def status(self) -> str:
        """How the run stands, in a line; empty before its first line of history."""
        history = self._run.read_history()
        if not history:
            return ""
        last = history[-1]
        iterations = self._run.read_config()["config"]["iterations"]
        known = [line["psnr"] for line in history if line.get("psnr") is not None]
        quality = f", {known[-1]:.2f} dB on test views" if known else ""
        state = "done" if self._run.metrics_path.is_file() else "running"
        return f"{state}: iteration {last['iteration']:,} of {iterations:,}{quality}"

    def _stamp(self) -> tuple[int, int] | None:
        try:
            found = self._run.soup_path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size
