"""Runs of a grid (objects x variants x seeds), each in a run directory OUT/runs/OBJECT/VARIANT[ seed N].

One that is finished is not repeated, one that was cut short goes on from its last checkpoint. How and where they run is
`etsplat.tasks.sweeps`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Settings
from etsplat.tasks.sweeps import cells
from etsplat.tasks.sweeps.work import Work
from studies.grid.variants import Variant
from studies.peers import settings
from studies.peers.settings import PeerConfig


class Cell(cells.Cell):
    """One run of a grid; of a peer too."""

    def work(self, threads: int) -> Work:
        """For a process somewhere."""
        if not isinstance(self.config, PeerConfig):
            return super().work(threads)
        options = {"images": self.images, "load_gsplat": settings.load_gsplat}
        return Work(run_peer, self.place(), self.folder.absolute(), self.config, options, threads)


def make_cells(
    meshes: dict[str, Path], variants: Sequence[Variant], base: ReconstructConfig, seeds: Sequence[int], out: Path
) -> list[Cell]:
    """All runs of a grid, object by object; those that are finished are "done".

    Raises:
        InputError: two variants have the same name.
    """
    if len({variant.name for variant in variants}) < len(variants):
        raise InputError("variants: one is named twice; leave one out")
    made = []
    for name, mesh in meshes.items():
        for seed in seeds:
            for variant in variants:
                folder = out / "runs" / name / (variant.name if len(seeds) == 1 else f"{variant.name} seed {seed}")
                cell = Cell(name, mesh, variant.name, variant.config(base, seed), folder)
                cell.look()
                made.append(cell)
    return made


def run_peer(
    source: str, folder: Path, config: Settings, *, images: str | None, load_gsplat: Any, resume: bool, callbacks: Any
) -> None:
    """A run of a Gaussian peer, drawn by the gsplat of whoever started the grid. It tells nobody how it goes."""
    settings.load_gsplat = load_gsplat
    from studies.peers.training import train_peer

    assert isinstance(config, PeerConfig)
    train_peer(Path(source), folder, config, images=images, resume=resume)
