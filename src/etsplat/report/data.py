"""What a run directory says, read once for all pages and pictures of the report."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory, is_run


@dataclass(frozen=True)
class TestView:
    """The pictures of one test view: paths of PNG files; `mesh` is the exported mesh drawn opaque."""

    name: str
    truth: Path
    render: Path
    mesh: Path


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: the run directory.
        config: `config.json`.
        metrics: `metrics.json`.
        history: one record per logged step, iterations increasing.
        views: test views that have all three pictures, by name.
        mesh: path of `mesh.ply`.
    """

    folder: Path
    config: dict[str, Any]
    metrics: dict[str, Any]
    history: list[dict[str, Any]]
    views: list[TestView]
    mesh: Path

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
    if not directory.metrics_path.is_file() or not directory.mesh_path(".ply").is_file():
        raise InputError(f"{folder}: this run has not finished; continue it with --resume")
    return Run(
        folder=folder,
        config=directory.read_config(),
        metrics=directory.read_metrics(),
        history=directory.read_history(),
        views=_find_views(directory.test),
        mesh=directory.mesh_path(".ply"),
    )


def _find_views(folder: Path) -> list[TestView]:
    names = sorted(path.name.removesuffix("_render.png") for path in folder.glob("*_render.png"))
    views = [TestView(name, *(folder / f"{name}_{kind}.png" for kind in ("truth", "render", "mesh"))) for name in names]
    return [view for view in views if view.truth.is_file() and view.mesh.is_file()]


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
