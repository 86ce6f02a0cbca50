"""What a run directory says, read once for all pages and pictures of the report."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.io.overview import TestView, find_test_views
from etsplat.io.run_directory import RunDirectory, is_run


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: the run directory.
        config: `config.json`.
        metrics: `metrics.json`, with what `etsplat eval` added to it.
        history: one record per logged step, iterations increasing.
        views: test views that have all three pictures, by name.
        mesh: path of `mesh.ply`; None for a soup.
    """

    folder: Path
    config: dict[str, Any]
    metrics: dict[str, Any]
    history: list[dict[str, Any]]
    views: list[TestView]
    mesh: Path | None

    @property
    def task(self) -> str:
        """What was run: "reconstruct" or "train"."""
        return self.config["task"]

    def series(self, key: str) -> tuple[list[float], list[float]]:
        """Iterations and values of the history records that have a finite `key`."""
        points = [(row["iteration"], row[key]) for row in self.history if _is_finite(row.get(key))]
        return [x for x, _ in points], [y for _, y in points]


def read_run(run_dir: Path | str) -> Run:
    """Read a run directory.

    Raises:
        InputError: not a run directory, damaged, or the run has not finished.
    """
    folder = Path(run_dir)
    directory = RunDirectory(folder)
    if not is_run(folder):
        raise InputError(f"{folder}: is not a run of etsplat; name a folder that was given to --out")
    config = directory.read_config()
    mesh = directory.mesh_path(".ply") if config["task"] == "reconstruct" else None
    if not directory.metrics_path.is_file() or not (mesh or directory.soup_path).is_file():
        raise InputError(f"{folder}: this run has not finished; continue it with --resume")
    return Run(
        folder=folder,
        config=config,
        metrics={**directory.read_metrics(), **directory.read_evaluation()},
        history=directory.read_history(),
        views=find_test_views(directory.test, "opaque" if mesh is None else "mesh"),
        mesh=mesh,
    )


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
