"""Cells of a grid: a run each, how it stands, and how all of them get to their ends."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.io.atomic import write_error
from etsplat.io.locks import RUN_LOCK
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Settings, get
from etsplat.tasks.sweeps.executors import Executor, LostError, Pending
from etsplat.tasks.sweeps.places import Where
from etsplat.tasks.sweeps.work import Work, log_of

RETRIES = 2
"""So many times a run whose process or machine was lost is begun again, from its last checkpoint."""

_POLL_SECONDS = 0.3


@dataclass
class Cell:
    """One run of a grid, and how it stands.

    Attributes:
        object: name of the input.
        source: its file or folder, or "demo:...".
        variant: name of what differs from other runs of that input but the seed.
        config: settings.
        folder: run directory.
        state: "waiting", "running", "done" or "failed".
        error: why it failed, in one line.
        images: of a scene, the folder of its photos; None for its own.
        store: where the run directory is kept beside the folder, as fsspec names it; None for nowhere.
    """

    object: str
    source: Path
    variant: str
    config: Settings
    folder: Path
    state: str = "waiting"
    error: str = ""
    images: str | None = None
    store: str | None = None
    _losses: int = field(default=0, repr=False)

    @property
    def seed(self) -> int:
        """Of the run."""
        return get(self.config, "seed")

    @property
    def log(self) -> Path:
        """What was said of the run."""
        return log_of(self.folder)

    def progress(self) -> float:
        """How much of the run is done, in [0, 1]."""
        run = RunDirectory(self.folder)
        history = run.read_history()
        return history[-1]["iteration"] / run.read_iterations() if history else 0.0

    def metrics(self) -> dict[str, Any]:
        """Those of the finished run."""
        return RunDirectory(self.folder).read_metrics()

    def is_finished(self) -> bool:
        """Whether the folder holds a finished run with these settings."""
        run = RunDirectory(self.folder)
        if not is_run(self.folder) or not run.metrics_path.exists():
            return False
        return run.read_config()["config"] == self.config.to_dict()

    def look(self) -> None:
        """Takes the state from the folder: "done" where that holds the finished run."""
        if self.store is not None and not self.is_finished():
            self._fetch()
        self.state = "done" if self.is_finished() else "waiting"

    def work(self, threads: int) -> Work:
        """For a process somewhere."""
        options = {} if self.images is None else {"images": self.images}
        return Work(run_task, self.place(), self.folder.absolute(), self.config, options, threads, self.store)

    def place(self) -> str:
        """The input, for processes that may have another current folder."""
        return str(self.source.absolute()) if self.source.exists() else str(self.source)  # the latter: "demo:scene"

    def conclude(self, pending: Pending) -> bool:
        """Takes in how an attempt at the run ended; returns whether another one is due."""
        try:
            self.error = pending.result()
        except LostError as error:
            self.error, self._losses = str(error), self._losses + 1
            self.state = "waiting" if self._losses <= RETRIES else "failed"
            return self.state == "waiting"
        self.look()
        if self.state != "done":
            self.state, self.error = "failed", self.error or "ended without a result"
        return False

    def _fetch(self) -> None:
        from etsplat.tasks.sweeps.store import Store

        assert self.store is not None
        Store(self.store, self.folder).fetch(results_only=True)


def run_task(source: str, folder: Path, config: Settings, **options: Any) -> None:
    """Reconstructs or trains, as the settings say."""
    if isinstance(config, ReconstructConfig):
        from etsplat.tasks.reconstruct import reconstruct

        reconstruct(source, folder, config, **options)
        return
    from etsplat.tasks.train import train
    from etsplat.tasks.train_config import TrainConfig

    assert isinstance(config, TrainConfig)
    train(source, folder, config, **options)


def run_cells(cells: Sequence[Cell], where: Where, show: Callable[[], None]) -> None:
    """Runs every cell that is waiting. Ctrl-C lets the runs save a checkpoint, then raises KeyboardInterrupt.

    A run whose process or machine is lost is begun again, from its last checkpoint; it ends with the same bits. Runs on
    this machine save a checkpoint of their own accord when this process is killed.

    Args:
        cells: changed in place.
        where: on this machine or a cluster.
        show: called a few times a second, and after every change.

    Raises:
        InputError: there is no cell, its folder cannot be made, or holds a run of an earlier version; or the cluster
            cannot be used.
    """
    if not cells:
        raise InputError("there is nothing to run: name at least one of everything that is compared, and one seed")
    waiting = [cell for cell in cells if cell.state == "waiting"]
    for cell in waiting:
        _prepare(cell)
    if not waiting:
        return show()
    executor = where.executor(len(waiting))
    try:
        _drive(executor, {executor.submit(cell.work(executor.threads)): cell for cell in waiting}, show)
    except BaseException:  # Ctrl-C, above all
        executor.stop()
        raise
    finally:
        executor.close()
        show()


def _drive(executor: Executor, pending: dict[Pending, Cell], show: Callable[[], None]) -> None:
    while pending:
        for cell in pending.values():
            cell.state = "running" if (cell.folder / RUN_LOCK).exists() else "waiting"
        show()
        time.sleep(_POLL_SECONDS)
        for attempt, cell in list(pending.items()):
            if attempt.done():
                del pending[attempt]
                if cell.conclude(attempt):
                    pending[executor.submit(cell.work(executor.threads))] = cell


def _prepare(cell: Cell) -> None:
    if is_run(cell.folder):
        RunDirectory(cell.folder).read_iterations()
    try:
        cell.folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(cell.folder, error) from error
