"""Runs of photos that carry fewer faces than they may have; of scenes `test_train` says so."""

from dataclasses import replace
from pathlib import Path

import pytest

from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.data.surface_pixels import surface_pixels
from etsplat.geometry.icosphere import icosphere
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.loop import Event, NoteEvent
from etsplat.tasks import pixel_limits
from etsplat.tasks.pixel_limits import within_pixels
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from helpers.reconstructions import SHORT, KilledError, kill_at, untimed


@pytest.fixture(scope="module")
def views() -> Dataset:
    return photograph(demo_object(), 32, 32, supersampling=1)


def ball(level: int) -> TriangleMesh:
    return TriangleMesh.from_mesh(*icosphere(level), colors=0.5, opacity=0.98, sigma=0.25)


def test_few_pixels_carry_few_faces_and_long_runs_are_shorter(views: Dataset) -> None:
    """A face for so many pixels of the start, but no fewer than that has; and as few iterations, but 5,000."""
    start = ball(2)
    pixels = surface_pixels(views, *start.surface())

    def fitting(faces: int, iterations: int = 30_000, start: TriangleMesh = start) -> tuple[ReconstructConfig, str]:
        each = pixels / (faces + 0.5)
        config = ReconstructConfig().changed({"pixels_per_face": each, "iterations": iterations})
        found, about = within_pixels(config, views, start)
        assert about is not None
        assert found == replace(config, max_faces=found.max_faces, iterations=found.iterations)
        return found, about

    found, about = fitting(50_000)
    assert (found.max_faces, found.iterations) == (50_000, 15_000)
    assert about.startswith("few pixels: at most 50,000 faces, not 100,000, and 15,000 iterations, not 30,000")
    for iterations, left in ((30_000, 5000), (4000, 4000)):
        found, about = fitting(1000, iterations)
        assert (found.max_faces, found.iterations) == (1000, left)
        assert ("iterations" in about) == (left < iterations)
    assert fitting(1000, start=ball(4))[0].max_faces == 5120


def test_photos_that_carry_all_faces_change_nothing(views: Dataset) -> None:
    """Nor does anything where that is switched off, as the paper has it."""
    start = ball(2)
    pixels = surface_pixels(views, *start.surface())
    for each in (pixels / 100_000, pixels / 200_000, None):
        config = ReconstructConfig().changed({"pixels_per_face": each})
        assert within_pixels(config, views, start) == (config, None)
    assert within_pixels(ReconstructConfig().changed({"max_faces": 5}), views, start)[1] is None
    assert ReconstructConfig.paper().pixels_per_face is None


def test_a_run_of_few_pixels_is_shorter_and_says_why(
    views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a note and in config.json; killed and resumed it has the same bits."""
    start = icosphere(2)
    pixels = surface_pixels(views, start[0] * SHORT.start.radius, start[1])
    config = SHORT.changed({"start.level": 2, "pixels_per_face": 2 * pixels / SHORT.max_faces})
    steps, events = SHORT.iterations // 2, list[Event]()
    monkeypatch.setattr(pixel_limits, "_FEWEST", steps)
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
