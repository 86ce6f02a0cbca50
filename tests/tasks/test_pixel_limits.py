"""Runs of photos that carry fewer faces than they may have; of scenes `test_train` says so."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.data.surface_pixels import surface_pixels
from etsplat.geometry.icosphere import icosphere
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.loop import Event, NoteEvent
from etsplat.tasks.pixel_limits import within_pixels
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from helpers.reconstructions import SHORT, KilledError, kill_at, untimed


@pytest.fixture(scope="module")
def views() -> Dataset:
    return photograph(demo_object(), 32, 32, supersampling=1)


def ball(level: int) -> TriangleMesh:
    return TriangleMesh.from_mesh(*icosphere(level), colors=0.5, opacity=0.98, sigma=0.25)


def test_few_pixels_carry_few_faces_and_as_few_iterations(views: Dataset) -> None:
    """A face for so many pixels of the start, but no fewer than that has; the rest of the settings stay."""
    start = ball(2)
    pixels = surface_pixels(views, *start.surface())
    config = ReconstructConfig().changed({"pixels_per_face": pixels / 1000.5})
    fitting, about = within_pixels(config, views, start)
    assert fitting == replace(config, max_faces=1000, iterations=300)
    assert about is not None
    assert about.startswith(
        "few pixels: at most 1,000 faces, not 100,000, and in proportion 300 iterations, not 30,000"
    )
    finer, _ = within_pixels(config, views, ball(4))
    assert (finer.max_faces, finer.iterations) == (5120, 1536)


def test_photos_that_carry_all_faces_change_nothing(views: Dataset) -> None:
    """Nor does anything where that is switched off, as the paper has it."""
    start = ball(2)
    pixels = surface_pixels(views, *start.surface())
    for each in (pixels / 100_000, pixels / 200_000, None):
        config = ReconstructConfig().changed({"pixels_per_face": each})
        assert within_pixels(config, views, start) == (config, None)
    assert within_pixels(ReconstructConfig().changed({"max_faces": 5}), views, start)[1] is None
    assert ReconstructConfig.paper().pixels_per_face is None


def test_a_run_of_few_pixels_is_shorter_and_says_why(views: Dataset, tmp_path: Path) -> None:
    """In a note and in config.json; killed and resumed it has the same bits."""
    start = icosphere(2)
    pixels = surface_pixels(views, torch.as_tensor(start[0]) * SHORT.start.radius, start[1])
    config = SHORT.changed({"start.level": 2, "pixels_per_face": 2 * pixels / SHORT.max_faces})
    steps, events = round(SHORT.iterations / 2), list[Event]()
    whole = reconstruct(views, tmp_path / "whole", config, callbacks=[events.append])
    assert whole.metrics["iterations"] == steps
    assert whole.metrics["faces"] <= SHORT.max_faces / 2
    record = RunDirectory(whole.path).read_config()
    assert (record["iterations"], record["config"]["iterations"]) == (steps, SHORT.iterations)
    assert any(isinstance(each, NoteEvent) and f"{steps} iterations, not" in each.text for each in events)
    with pytest.raises(KilledError):
        reconstruct(views, tmp_path / "killed", config, callbacks=[kill_at(steps // 2)])
    resumed = reconstruct(views, tmp_path / "killed", config, resume=True)
    assert untimed(resumed.path) == untimed(whole.path)
