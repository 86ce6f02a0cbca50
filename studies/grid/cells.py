"""Runs of a grid (objects x variants x seeds), in processes beside each other, each resumable.

A run is a run directory OUT/runs/OBJECT/VARIANT[ seed N]. One that is finished is not repeated, one that was cut short
goes on from its last checkpoint. As many processes run as there are cores, each with its share of them: a run on one
thread wastes nothing on waiting for others, so the grid as a whole is fastest that way, though no single run is.
"""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.core.processes import when_parent_ends
from etsplat.engines.threads import num_threads
from etsplat.io.atomic import write_error
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train_config import TrainConfig
from studies.grid.variants import Variant
from studies.peers.settings import PeerConfig

_POLL_SECONDS = 0.5
_SIGNALS = (signal.SIGINT, signal.SIGTERM)

AnyConfig = ReconstructConfig | TrainConfig | PeerConfig
"""Settings of a run; what kind of run it is follows from them."""


@dataclass
class Cell:
    """One run of a grid, and how it stands.

    Attributes:
        object: name of the mesh or scene.
        mesh: its file, or the scene's folder.
        variant: name of the variant.
        config: settings.
        folder: run directory.
        state: "waiting", "running", "done" or "failed".
        error: why it failed, in one line.
        images: of a scene, the folder of its photos; None for its own.
    """

    object: str
    mesh: Path
    variant: str
    config: AnyConfig
    folder: Path
    state: str = "waiting"
    error: str = ""
    images: str | None = None
    _process: Any = field(default=None, repr=False)

    def progress(self) -> float:
        """How much of the run is done, in [0, 1]."""
        run = RunDirectory(self.folder)
        history = run.read_history()
        return history[-1]["iteration"] / run.read_iterations() if history else 0.0

    def metrics(self) -> dict[str, Any]:
        """Those of the finished run."""
        return RunDirectory(self.folder).read_metrics()


def make_cells(
    meshes: dict[str, Path], variants: Sequence[Variant], base: ReconstructConfig, seeds: Sequence[int], out: Path
) -> list[Cell]:
    """All runs of a grid, object by object; those that are finished are "done".

    Raises:
        InputError: two variants have the same name.
    """
    if len({variant.name for variant in variants}) < len(variants):
        raise InputError("variants: one is named twice; leave one out")
    cells = []
    for name, mesh in meshes.items():
        for seed in seeds:
            for variant in variants:
                folder = out / "runs" / name / (variant.name if len(seeds) == 1 else f"{variant.name} seed {seed}")
                cell = Cell(name, mesh, variant.name, variant.config(base, seed), folder)
                cell.state = "done" if is_finished(cell) else "waiting"
                cells.append(cell)
    return cells


def count_jobs(asked: int) -> int:
    """How many runs go beside each other: as many as asked for, or one for each core for 0.

    Raises:
        InputError: it is negative.
    """
    if asked < 0:
        raise InputError(f"jobs: is {asked}; it must be at least 1, or 0 for one on each core")
    return asked or num_threads()


def run_grid(cells: Sequence[Cell], jobs: int, show: Callable[[], None]) -> None:
    """Runs every cell that is waiting. Ctrl-C lets the runs save a checkpoint, then raises KeyboardInterrupt.

    The processes do the same of their own accord when this one is killed.

    Args:
        cells: changed in place.
        jobs: processes beside each other; they share the cores evenly.
        show: called about twice a second, and after every change.

    Raises:
        InputError: there is no cell, its folder cannot be made, or holds a run of an earlier version.
    """
    if not cells:
        raise InputError("there is nothing to run: name at least one of everything that is compared, and one seed")
    waiting = [cell for cell in cells if cell.state == "waiting"]
    for cell in waiting:
        if is_run(cell.folder):
            RunDirectory(cell.folder).read_iterations()
    jobs = max(1, min(jobs, len(waiting)))
    threads = max(1, num_threads() // jobs)
    running: list[Cell] = []
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                cell = waiting.pop(0)
                _start(cell, running, threads)
            show()
            time.sleep(_POLL_SECONDS)
            for cell in [cell for cell in running if not cell._process.is_alive()]:
                running.remove(cell)
                _conclude(cell)
    except BaseException:  # Ctrl-C, above all
        for cell in running:
            os.kill(cell._process.pid, signal.SIGINT)
        for cell in running:
            cell._process.join()
        raise
    finally:
        show()


def _start(cell: Cell, running: list[Cell], threads: int) -> None:
    """Gives it a process. Signals wait until it is among the running ones; in the process, until it is ready for them.

    Without that, Ctrl-C in the seconds in which processes start would end them with tracebacks.
    """
    try:
        cell.folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(cell.folder, error) from error
    _error_file(cell).unlink(missing_ok=True)
    cell._process = multiprocessing.get_context("spawn").Process(
        target=_work, args=(cell.mesh, cell.folder, cell.config, cell.images, threads)
    )
    resource_tracker.ensure_running()  # which lets signals through (before Python 3.12)
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        cell._process.start()
        cell.state = "running"
        running.append(cell)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


def _conclude(cell: Cell) -> None:
    if cell._process.exitcode == 0 and is_finished(cell):
        cell.state = "done"
        return
    cell.state = "failed"
    path = _error_file(cell)
    cell.error = path.read_text(encoding="utf-8") if path.exists() else f"ended with status {cell._process.exitcode}"


def _work(mesh: Path, folder: Path, config: AnyConfig, images: str | None, threads: int) -> None:
    """One run, in a process of its own, which is interrupted when the one that started it ends."""
    os.setpgrp()  # Ctrl-C in a terminal reaches the parent alone, which passes it on once: twice would kill
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs are started with it ignored
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        when_parent_ends(lambda: os.kill(os.getpid(), signal.SIGINT))
        _run(mesh, folder, config, images, threads)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except Exception as error:
        text = " ".join(str(error).split()) or repr(error)
        try:
            _error_path(folder).write_text(text, encoding="utf-8")
        except OSError:  # somebody removed the whole grid
            raise SystemExit(f"etsplat: {text}") from None
        raise SystemExit(1) from None


def _run(mesh: Path, folder: Path, config: AnyConfig, images: str | None, threads: int) -> None:
    from etsplat.engines.threads import set_num_threads
    from etsplat.tasks.reconstruct import reconstruct
    from etsplat.tasks.train import train
    from studies.peers.training import train_peer

    set_num_threads(threads)
    if isinstance(config, PeerConfig):
        train_peer(mesh, folder, config, images=images, resume=is_run(folder))
    elif isinstance(config, TrainConfig):
        train(mesh, folder, config, images=images, resume=is_run(folder))
    else:
        reconstruct(mesh, folder, config, resume=is_run(folder))


def _error_file(cell: Cell) -> Path:
    return _error_path(cell.folder)


def _error_path(folder: Path) -> Path:
    return folder.parent / f"{folder.name}.error.txt"


def is_finished(cell: Cell) -> bool:
    """Whether the folder holds a finished run with these settings."""
    run = RunDirectory(cell.folder)
    if not is_run(cell.folder) or not run.metrics_path.exists():
        return False
    return run.read_config()["config"] == cell.config.to_dict()
