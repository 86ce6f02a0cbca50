"""A grid of soups: scenes by methods, with and without culling of small triangles; and what is measured of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from etsplat.bench.grid import Cell, is_finished
from etsplat.bench.paper_nvs import SCENES
from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.train_config import TrainConfig, train_settings

CULLED = "culling"
"""What is added to the name of a method whose small triangles are culled."""

METRICS = (
    "psnr",
    "ssim",
    "ssim_interior",
    "lpips_3dgs",
    "lpips",
    "psnr_opaque",
    "ssim_opaque",
    "fps",
    "ms_per_million",
)


def make_nvs_cells(
    scenes: Sequence[Path],
    methods: Sequence[str],
    out: Path,
    *,
    preset: str,
    culling: Sequence[bool],
    changes: dict[str, Any],
    scene_type: str,
) -> list[Cell]:
    """All runs, scene by scene; those that are finished are "done".

    With preset "paper", scenes of the paper's tables get Triangle Splatting's settings for them: kind of scene, folder
    of photos and number of triangles.

    Args:
        scenes: folders; the folder's name is the scene's.
        methods: as `TrainConfig.method`.
        out: folder; runs are in OUT/runs/SCENE/VARIANT.
        preset: of all runs.
        culling: whether small triangles are culled; one or both.
        changes: settings for all runs.
        scene_type: of scenes that are not the paper's.

    Raises:
        InputError: a scene is missing, or two have the same name.
    """
    names = [scene.resolve().name for scene in scenes]
    for scene, name in zip(scenes, names, strict=True):
        if not scene.is_dir():
            raise InputError(f"scene {scene}: no such folder; fetch it with `etsplat data download`, or check the path")
        if names.count(name) > 1:
            raise InputError(f"scenes: two are named {name}; rename a folder")
    cells = []
    for scene, name in zip(scenes, names, strict=True):
        base, images = _settings(name, scene, preset, scene_type)
        for culled in culling:
            for method in methods:
                variant = f"{method} {CULLED}" if culled else method
                config = replace(base, **{"method": method, "cull_small": culled, **changes})
                cell = Cell(name, scene, variant, config, out / "runs" / name / variant, images=images)
                cell.state = "done" if is_finished(cell) else "waiting"
                cells.append(cell)
    return cells


def evaluate_cells(
    cells: Sequence[Cell], lpips_weights: Path | None, progress: Callable[[int, int], None]
) -> list[dict[str, Any]]:
    """Measures every finished run that has not been measured yet, one after the other; returns a row for each.

    Speed is measured here, with nothing else running, and not while the grid runs.
    """
    from etsplat.tasks.evaluate_soup import evaluate_run
    from etsplat.tasks.soup_run import open_run

    done, rows = [cell for cell in cells if cell.state == "done"], []
    for index, cell in enumerate(done):
        run = RunDirectory(cell.folder)
        if not run.evaluation_path.is_file():
            run.write_evaluation(evaluate_run(open_run(cell.folder), lpips_weights=lpips_weights))
        progress(index + 1, len(done))
        metrics, evaluation = run.read_metrics(), run.read_evaluation()
        rows.append(
            {
                "scene": cell.object,
                "variant": cell.variant,
                **{name: evaluation[name] for name in METRICS},
                "triangles": metrics["triangles"],
                "iterations": metrics["iterations"],
                "minutes": metrics["seconds"] / 60,
                "width": evaluation["width"],
                "height": evaluation["height"],
            }
        )
    return rows


def _settings(name: str, scene: Path, preset: str, scene_type: str) -> tuple[TrainConfig, str | None]:
    known = SCENES.get(name) if preset == "paper" else None
    if known is None:
        return train_settings(preset, scene_type), None
    config = replace(train_settings(preset, known.scene_type), max_triangles=known.max_triangles)
    return config, known.images if (scene / known.images).is_dir() else None
