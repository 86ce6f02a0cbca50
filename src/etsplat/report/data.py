"""What a run directory says, read once for all pages and pictures of the report."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.core.spelling import either, option
from etsplat.io.json_text import check_entries, is_number
from etsplat.io.overview import TestView, find_test_views
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.report.command import CONFIGS
from etsplat.tasks.opened_runs import read_record

_NEEDED: dict[str, Any] = {
    "iterations": int,
    "seconds": float,
    "seconds_per_iteration": float,
    "engine": str,
    "method": str,
    "preset": str,
    "seed": int,
    "versions": dict,
}
_COUNTS = {"reconstruct": "faces", "train": "triangles"}
"""What the result has so many of, by task."""

_MEASURED = (
    *("psnr", "psnr_affine", "psnr_aligned", "ssim", "flip", "lpips", "lpips_3dgs"),
    *("psnr_mesh", "psnr_opaque", "psnr_asset", "psnr_textured", "silhouette_iou"),
    *("chamfer", "chamfer_floor", "chamfer_exact", "f_score", "fps", "ms_per_million"),
    *("watched_psnr", "watched_psnr_last", "watched_psnr_given_cameras", "watched_psnr_refined_cameras"),
    *("sigma", "sigma_10", "sigma_90", "opacity", "opacity_10", "opacity_90"),
)
"""Numbers that may be missing, or null, where they were not measured."""

_COUNTED = (
    *("vertices", "degenerate_faces", "self_intersections", "edits_undone"),
    *("watched_views", "result_iteration", "asset_triangles", "textured_faces", "texture"),
)
"""Whole numbers of that kind."""

_OPTIONAL: dict[str, Any] = {
    **dict.fromkeys(_MEASURED, float | None),
    **dict.fromkeys(_COUNTED, int | None),
    "cameras_refined": bool,
    "lpips_reason": str | None,
    "judgement": dict,
    "judgement.verdict": str,
    "threads": int,
}


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

    @property
    def verdict(self) -> str | None:
        """Whether the result is good, and if not why; None for a soup, and for a mesh that nobody judged."""
        return self.metrics.get("judgement", {}).get("verdict")

    def series(self, key: str) -> tuple[list[float], list[float]]:
        """Iterations and values of the history records whose `key` is a number."""
        points = [(float(row["iteration"]), float(row[key])) for row in self.history if is_number(row.get(key))]
        return [x for x, _ in points], [y for _, y in points]


def read_run(run_dir: Path | str) -> Run:
    """Read a run directory.

    Raises:
        InputError: not a run directory, damaged, or the run has not finished.
    """
    folder = Path(run_dir)
    directory = RunDirectory(folder)
    if not is_run(folder):
        a_run = either("a folder that was given to --out", "the folder of one")
        raise InputError(f"{folder}: is not a run of etsplat; name {a_run}")
    task = directory.read_config()["task"]
    if task not in _COUNTS:
        raise InputError(f"{folder}: is a run without a report; name one of `etsplat reconstruct` or `etsplat train`")
    mesh = directory.mesh_path(".ply") if task == "reconstruct" else None
    if not directory.metrics_path.is_file() or not (mesh or directory.soup_path).is_file():
        raise InputError(f"{folder}: this run has not finished; continue it with {option('resume', True)}")
    kind = CONFIGS[task]
    config = read_record(directory, kind, kind.LABELS, "source", "paths.source", "versions.etsplat")
    metrics, evaluation = directory.read_metrics(), directory.read_evaluation()
    needed = {**_NEEDED, _COUNTS[task]: int}
    check_entries(directory.metrics_path, metrics, {**needed, **_OPTIONAL}, needed)
    check_entries(directory.evaluation_path, evaluation, {**needed, **_OPTIONAL})
    return Run(
        folder=folder,
        config=config,
        metrics={**metrics, **evaluation},
        history=directory.read_history(),
        views=find_test_views(directory.test, "opaque" if mesh is None else "mesh"),
        mesh=mesh,
    )
