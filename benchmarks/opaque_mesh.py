"""The opaque mesh of a capture alone, without the soft soup beside which `etsplat train` makes it.

    python -m benchmarks.opaque_mesh data/fox --width 270 --soups runs/soups
    python -m benchmarks.opaque_mesh data/lego --scene-type object --background white --soups runs/soups

A row of a table in Markdown: PSNR and SSIM of the test views as a mesh viewer draws them, triangles, and seconds of one
processor's time that fitting the mesh took, with drawing the soft soup's views. Both soups that it is made of are kept
in the folder: what changes in the mesh's own stage is compared from the same start. The capture must have points.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch

from etsplat.data.dataset import Dataset
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.exposure import Exposure
from etsplat.optim.schedules import limited_iterations
from etsplat.tasks.opaque import finished_mesh, mesh_steps, mesh_views, start_mesh, towards_opaque
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.soft_views import with_soft_views
from etsplat.tasks.soup_trainer import background_of, start_trainer
from etsplat.tasks.sources import kept_aside, load_scene
from etsplat.tasks.train_config import TrainConfig


def fitted(capture: Dataset, config: TrainConfig, kept: Path) -> tuple[TriangleMesh, float]:
    """The mesh, and the seconds of processor time that its stage took; soups are kept in a folder, or found there."""
    assert capture.exact_points is not None, "the capture must have points"
    soft, exposure = _soup(capture, replace(config, asset=False), kept / "soft", None)
    opaque, _ = _soup(capture, towards_opaque(capture, config), kept / "opaque", exposure)
    began = time.process_time()
    views = with_soft_views(capture, soft, mesh_views(config), background_of(config), config.seed)
    trainer = start_mesh(opaque, exposure, capture, views, config)
    trainer.fit(mesh_steps(config))
    return finished_mesh(trainer.outcome().model, views), time.process_time() - began


def _soup(
    capture: Dataset, config: TrainConfig, kept: Path, exposure: Exposure | None
) -> tuple[TriangleSoup, Exposure]:
    """A soup that is trained on the capture's own points, and its exposures; those of another, if it has any."""
    trainer = start_trainer(capture, config)
    if exposure is not None:
        trainer.exposure.take_over(exposure)
    trainer.fit(config.iterations, run=kept)
    return trainer.outcome().model.finished(), trainer.exposure


def start(description: str | None) -> tuple[Dataset, TrainConfig, Path]:
    """What the command line names: a capture, the settings of its run, and the folder where its soup is kept."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--scene-type", default="outdoor")
    parser.add_argument("--width", type=int, default=400)
    parser.add_argument("--max-triangles", type=int, default=40_000)
    parser.add_argument("--background", default="black")
    parser.add_argument("--soups", type=Path, required=True)
    given = parser.parse_args()
    settings = {name: getattr(given, name) for name in ("width", "max_triangles", "background")}
    config = TrainConfig.of("quick", given.scene_type).changed(settings)
    own = kept_aside(load_scene(given.scene, config.width, None, None), config.watch, config.refine_cameras)
    capture = own.renormalized(own.frame.center, own.frame.radius)
    steps = limited_iterations(config.iterations, config.schedule.max_epochs, len(own.train), config.batch)
    kept = given.soups / f"{given.scene.name}-{given.width}-{given.max_triangles}"
    return capture, config.changed({"iterations": steps}), kept


def main() -> None:
    """One capture."""
    capture, config, kept = start(__doc__)
    mesh, seconds = fitted(capture, config, kept)
    scorer = Scorer(capture, torch.device("cpu"), background=background_of(config))
    (kept / "test").mkdir(exist_ok=True)
    found = scorer.asset(mesh, kept / "test")
    print(f"| {kept.name} | {found['psnr_asset']:.2f} / {found['ssim_asset']:.3f} | {mesh.count:,} | {seconds:.0f} |")


if __name__ == "__main__":
    main()
