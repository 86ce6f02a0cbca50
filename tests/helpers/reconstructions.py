"""Short reconstructions, and what compares them."""

from collections.abc import Callable
from pathlib import Path

import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.io.run_directory import RunDirectory
from etsplat.optim.loop import Event, NoteEvent, PrepareEvent, StageEvent
from etsplat.tasks.reconstruct_config import ReconstructConfig

TINY = ReconstructConfig.tiny()
# Shorter still, with subdivisions at iterations 4, 14, 24, 34 and checkpoints at 10, 20, ...
SHORT = TINY.changed(
    {
        "iterations": 40,
        "refinement.first": 0.1,
        "refinement.last": 0.85,
        "refinement.subdivisions": 4,
        "output.checkpoint_every": 10,
        "output.log_every": 3,
    }
)


class KilledError(Exception):
    """Stands for a kill: the run gets no chance to save anything."""


def kill_at(iteration: int) -> Callable[[Event], None]:
    """A callback that dies at the first event of an iteration or later."""

    def callback(event: Event) -> None:
        if not isinstance(event, PrepareEvent | NoteEvent | StageEvent) and event.iteration >= iteration:
            raise KilledError

    return callback


def pebble_mesh() -> MeshFile:
    """A smooth, lopsided closed shape, not centred, not of unit size."""
    vertices, faces = icosphere(4)
    vertices = vertices * torch.tensor([1.0, 0.6, 0.8]) * (1 + 0.1 * torch.sin(4 * vertices[:, :1]))
    return MeshFile(7.0 * vertices + torch.tensor([3.0, -1.0, 2.0]), faces)


def untimed(run: Path) -> dict[str, object]:
    """All that a run leaves, except for times and what an interruption may differ in."""
    directory = RunDirectory(run)
    metrics = {key: value for key, value in directory.read_metrics().items() if not key.startswith("seconds")}
    history = [{k: v for k, v in line.items() if k != "seconds"} for line in directory.read_history()]
    meshes = {suffix: directory.mesh_path(suffix).read_bytes() for suffix in (".ply", ".obj", ".glb")}
    pictures = {path.name: path.read_bytes() for path in sorted(directory.test.iterdir())}
    return {"metrics": metrics, "history": history, "meshes": meshes, "pictures": pictures}
