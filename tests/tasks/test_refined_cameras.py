"""Runs of both tasks that refine cameras: who judges, what is written, and what sees by it ever after."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import etsplat
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.photograph import photograph
from etsplat.io.refined_camera_files import read_refined_cameras
from etsplat.io.run_directory import RunDirectory
from etsplat.optim import camera_trial
from etsplat.optim.loop import NoteEvent
from etsplat.report.cards import cards_of
from etsplat.report.data import read_run
from etsplat.tasks.camera_results import angle
from etsplat.tasks.export_mesh import Reconstruction
from etsplat.tasks.opened_runs import SoupRun
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.refined_cameras import alignment_starts, kept_aside, refined_capture
from etsplat.tasks.scoring import evaluate_run
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig

SCENE = TrainConfig.tiny().changed({"iterations": 40, "refine_cameras": "all", "max_triangles": 400})
OBJECT = ReconstructConfig.tiny().changed(
    {"iterations": 40, "refine_cameras": "poses", "output.chamfer_samples": 1000, "refinement.subdivisions": 2}
)


@pytest.fixture(scope="module")
def scene() -> Dataset:
    scene = demo_scene(32, 24)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    return replace(scene, exact_points=scene.exact_points[::60], point_colors=scene.point_colors[::60])


@pytest.fixture(scope="module")
def views() -> Dataset:
    return photograph(etsplat.demo_object(), 24, 24, elevations=(0.0, 30.0), azimuths=8, supersampling=1)


def test_photos_are_kept_aside_to_judge(scene: Dataset) -> None:
    """As many as a run would keep anyhow; where it would keep none, some, and that is said."""
    few = replace(scene, train=scene.train[:10])
    assert kept_aside(few, None, "off") is few
    kept = kept_aside(few, 0, "poses")
    assert (len(kept.train), len(kept.watched)) == (8, 2)
    assert "2 photos are kept from training" in kept.notes[-1]
    asked = kept_aside(few, 3, "poses")
    assert len(asked.watched) == 3
    assert asked.notes == few.notes
    with pytest.raises(InputError, match=r"refine_cameras: .*3 are too few"):
        kept_aside(replace(scene, train=scene.train[:3]), None, "poses")


def refined_run(scene: Dataset, out: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> tuple[Any, list[str]]:
    """A run whose cameras stay refined whatever the photos kept aside say; and its notes."""
    monkeypatch.setattr(camera_trial, "NEEDED", -100.0)
    notes: list[str] = []

    def listen(event: object) -> None:
        if isinstance(event, NoteEvent):
            notes.append(event.text)

    return train(scene, out, SCENE, callbacks=[listen], **options), notes


def test_a_scene_is_seen_by_refined_cameras_ever_after(
    scene: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """cameras.json is in the capture's own units; test views stay, and are scored as given and aligned."""
    result, notes = refined_run(scene, tmp_path / "run", monkeypatch)
    metrics = result.metrics
    assert metrics["cameras_refined"] is True
    assert metrics["psnr_aligned"] > metrics["psnr"] - 0.3, "aligned by another loss"
    assert any("cameras.json has them" in note for note in notes)
    cameras = read_refined_cameras(tmp_path / "run")
    assert sorted(cameras) == sorted(scene.names[view] for view in scene.train)
    assert any(not camera.training for camera in cameras.values())
    seen = refined_capture(scene, tmp_path / "run")
    assert torch.equal(seen.viewmats[scene.test], scene.viewmats[scene.test])
    for view in scene.train:
        row = cameras[scene.names[view]]
        assert angle(scene.viewmats[view], seen.viewmats[view]) == pytest.approx(row.turned_degrees, abs=1e-6)
        assert float((seen.centers[view] - scene.centers[view]).norm()) == pytest.approx(row.shifted, abs=1e-6)
        assert 0 < row.shifted_of_distance < 0.5
    away = scene.renormalized(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 2.0)
    again = refined_capture(away, tmp_path / "run")
    expected = seen.renormalized(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 2.0)
    torch.testing.assert_close(again.viewmats, expected.viewmats)
    half = refined_capture(scene.halved(), tmp_path / "run")
    torch.testing.assert_close(2 * half.Ks[scene.train, 0, 0], seen.Ks[scene.train, 0, 0])

    starts = alignment_starts(scene, seen)
    assert sorted(starts) == scene.test
    assert starts[scene.test[0]].Ks[0, 0, 0] == seen.Ks[scene.train[0], 0, 0].float()
    found = evaluate_run(SoupRun(tmp_path / "run", result.soup, seen, None, starts))
    assert found["psnr_aligned"] == pytest.approx(metrics["psnr_aligned"], abs=0.05)
    titles = {card.title: card.value for card in cards_of(read_run(tmp_path / "run"))}
    assert titles["Cameras"] == "refined"
    assert "cameras.json" in (tmp_path / "run" / "README.txt").read_text()


def test_an_object_is_textured_by_refined_cameras(
    views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The views of a reconstruction are those that the run saw."""
    monkeypatch.setattr(camera_trial, "NEEDED", -100.0)
    result = reconstruct(views, tmp_path / "run", OBJECT)
    assert result.metrics["cameras_refined"] is True
    run = RunDirectory(tmp_path / "run")
    done = Reconstruction.of(run, views, torch.device("cpu"))
    assert torch.equal(done.views.viewmats, refined_capture(views, run.path).viewmats)
    assert not torch.equal(done.views.viewmats[views.train], views.viewmats[views.train])


def test_where_refining_does_no_good_the_run_is_that_without_it(
    scene: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit; it writes no cameras, says so, and aligns test views all the same."""
    monkeypatch.setattr(camera_trial, "NEEDED", 100.0)
    kept = kept_aside(scene, 0, "poses")
    tried = train(kept, tmp_path / "tried", SCENE)
    plain = train(kept, tmp_path / "plain", SCENE.changed({"refine_cameras": "off"}))
    assert torch.equal(tried.soup.vertices, plain.soup.vertices)
    assert tried.metrics["psnr"] == plain.metrics["psnr"]
    assert tried.metrics["cameras_refined"] is False
    assert tried.metrics["watched_psnr_refined_cameras"] is not None
    assert "psnr_aligned" in tried.metrics
    assert "psnr_aligned" not in plain.metrics
    assert not (tmp_path / "tried" / "cameras.json").exists()
