"""Checkpoints: one safetensors file each, written whole or not at all, bound to the run that wrote it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io.tensors import read_tensors, save_tensors

FORMAT = "etsplat checkpoint 1"


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds.

    Attributes:
        path: the file.
        iteration: iterations done.
        tensors: by name, on the CPU, with the bits they were saved with.
    """

    path: Path
    iteration: int
    tensors: dict[str, Tensor]


def checkpoint_path(folder: Path, iteration: int) -> Path:
    """Where the checkpoint of an iteration lies; names sort by iteration."""
    return folder / f"step_{iteration:06d}.safetensors"


def save_checkpoint(folder: Path, iteration: int, tensors: Mapping[str, Tensor], run_hash: str) -> Path:
    """Writes a checkpoint atomically, then deletes all but it and the one before.

    Those of later iterations, which a run has that went back, go too.

    Args:
        folder: must exist.
        iteration: iterations done.
        tensors: everything that the rest of the run depends on.
        run_hash: identifies the run's settings and input; `load_checkpoint` insists on the same.

    Raises:
        InputError: the folder cannot be written to, or the disk is full; earlier checkpoints are left as they were.
    """
    path = checkpoint_path(folder, iteration)
    metadata = {"format": FORMAT, "iteration": str(iteration), "run_hash": run_hash}
    save_tensors(path, tensors, metadata)
    others = [other for other in list_checkpoints(folder) if other != path]
    earlier = [other for other in others if _by_iteration(other) < _by_iteration(path)]
    for other in set(others) - set(earlier[-1:]):
        other.unlink(missing_ok=True)
    return path


def list_checkpoints(folder: Path) -> list[Path]:
    """Checkpoint files of a folder, oldest first; empty if the folder does not exist."""
    return sorted(folder.glob("step_*.safetensors"), key=_by_iteration)


def load_latest_checkpoint(folder: Path, run_hash: str) -> Checkpoint | None:
    """Reads the newest checkpoint of a folder, or None if it has none.

    Raises:
        InputError: the file is damaged, or of a run with other settings or input. The message names the checkpoint
            before it where there is one: a run never falls back to it by itself.
    """
    paths = list_checkpoints(folder)
    if not paths:
        return None
    path, earlier = paths[-1], paths[:-1]
    remedy = f"delete it to resume from {earlier[-1].name}" if earlier else "delete it and resume to start again"
    try:
        tensors, metadata = read_tensors(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: cut short or damaged ({_first_line(error)}); {remedy}") from error
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: not a checkpoint of this version of etsplat; {remedy}")
    if metadata.get("run_hash") != run_hash:
        raise InputError(
            f"{path}: belongs to a run with other settings or input; resume with the same, or choose another folder"
        )
    iteration = metadata.get("iteration", "")
    if not re.fullmatch(r"[0-9]{1,18}", iteration):
        raise InputError(f"{path}: does not say which iteration it is of; {remedy}")
    return Checkpoint(path, int(iteration), tensors)


def _by_iteration(path: Path) -> tuple[int, str]:
    return len(path.name), path.name


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
