"""Runs whose process is lost in the middle, once."""

import hashlib
import os
import shutil
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from safetensors.torch import load_file, save

from etsplat.optim.loop import Callback, CheckpointEvent
from etsplat.tasks.sweeps.cells import Cell, run_task
from etsplat.tasks.sweeps.work import Work
from tests.helpers.reconstructions import untimed


class LostCell(Cell):
    """A cell whose first attempt is killed after its first checkpoint; its folder is lost too where a copy is kept."""

    def work(self, threads: int) -> Work:
        options = {"forget": self.store is not None}
        return Work(die_once, str(self.source), self.folder, self.config, options, threads, self.store)


class StuckCell(Cell):
    """A cell that stays where it is after its first checkpoint, on the Ray node that is doomed, until that is gone."""

    doomed: str

    def work(self, threads: int) -> Work:
        return Work(stop_on, str(self.source), self.folder, self.config, {"node": self.doomed}, threads)


def die_once(
    source: str, folder: Path, config: Any, *, forget: bool, resume: bool, callbacks: Sequence[Callback]
) -> None:
    def die(event: object) -> None:
        if isinstance(event, CheckpointEvent) and not resume:
            if forget:
                shutil.rmtree(folder)
            os.kill(os.getpid(), signal.SIGKILL)

    run_task(source, folder, config, resume=resume, callbacks=[*callbacks, die])


def stop_on(source: str, folder: Path, config: Any, *, node: str, resume: bool, callbacks: Sequence[Callback]) -> None:
    import ray

    here = ray.get_runtime_context().get_node_id() == node

    def wait(event: object) -> None:
        if isinstance(event, CheckpointEvent) and here:
            (folder.parent / f"{folder.name} waits").touch()
            time.sleep(600)

    run_task(source, folder, config, resume=resume, callbacks=[*callbacks, wait])


def digest(folder: Path) -> str:
    """Of the last checkpoint and all results, but for times."""
    checkpoint = load_file(max((folder / "checkpoints").iterdir()))
    checkpoint["progress"][0] = 0  # seconds
    return hashlib.sha256(save(checkpoint) + repr(untimed(folder)).encode()).hexdigest()
