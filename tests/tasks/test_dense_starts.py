"""Whole runs that start at what photos agree on."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.pictures import StoredPictures
from etsplat.optim.loop import Event, NoteEvent
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from tests.helpers.reconstructions import KilledError, kill_at

DENSE = TrainConfig.tiny().changed(
    {"width": None, "iterations": 40, "start.dense": True, "max_triangles": 6000, "output.checkpoint_every": 10}
)


@pytest.fixture(scope="module")
def scene() -> Dataset:
    scene = demo_scene(96, 72)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    return replace(scene, exact_points=scene.exact_points[::40], point_colors=scene.point_colors[::40])


def joined(events: list[Event]) -> bool:
    return any(isinstance(each, NoteEvent) and "of these places join" in each.text for each in events)


def test_a_dense_start_is_the_same_after_a_kill_and_whatever_test_photos_show(scene: Dataset, tmp_path: Path) -> None:
    """The soup to the bit; with more triangles than the capture has points before any is added."""
    events = list[Event]()
    whole = train(scene, tmp_path / "whole", DENSE, callbacks=[events.append]).soup
    assert joined(events)
    assert scene.exact_points is not None
    assert whole.count > 2 * len(scene.exact_points)
    with pytest.raises(KilledError):
        train(scene, tmp_path / "killed", DENSE, callbacks=[kill_at(20)])
    resumed = train(scene, tmp_path / "killed", DENSE, resume=True, callbacks=[lambda event: None]).soup
    black = [torch.zeros_like(image) if view in scene.test else image for view, image in enumerate(scene.images)]
    other = train(replace(scene, images=StoredPictures(black)), tmp_path / "other", DENSE, callbacks=[events.append])
    for soup in (resumed, other.soup):
        for name, values in whole.state().items():
            assert torch.equal(soup.state()[name], values), name


def test_what_becomes_opaque_starts_at_the_capture_s_points(scene: Dataset, tmp_path: Path) -> None:
    """It has triangles left to grow where they are needed."""
    events = list[Event]()
    train(scene, tmp_path, DENSE.changed({"finish": "opaque"}), callbacks=[events.append])
    assert not joined(events)


def test_a_run_by_doubtful_poses_says_so_and_ends_sooner(scene: Dataset, tmp_path: Path) -> None:
    """Photos of other places than the poses say; resumed, it has the same length and the same bits."""
    dealt = torch.randperm(len(scene), generator=torch.Generator().manual_seed(0)).tolist()
    swapped = replace(scene, images=StoredPictures([scene.images[view] for view in dealt]))
    config = DENSE.changed({"schedule.doubtful_epochs": 1})
    events = list[Event]()
    whole = train(swapped, tmp_path / "whole", config, callbacks=[events.append])
    steps = len(scene.watching().train)
    assert whole.metrics["iterations"] == steps < config.iterations
    told = [event.text for event in events if isinstance(event, NoteEvent) and event.text.startswith("poses: ")]
    assert len(told) == 1
    assert f"{steps} iterations, not 40 (schedule.doubtful_epochs 1)" in told[0]
    with pytest.raises(KilledError):
        train(swapped, tmp_path / "killed", config, callbacks=[kill_at(20)])
    resumed = train(swapped, tmp_path / "killed", config, resume=True, callbacks=[lambda event: None])
    assert resumed.metrics["iterations"] == steps
    assert torch.equal(resumed.soup.vertices, whole.soup.vertices)


def test_right_poses_are_not_doubted(scene: Dataset, tmp_path: Path) -> None:
    events = list[Event]()
    done = train(scene, tmp_path, DENSE.changed({"schedule.doubtful_epochs": 1}), callbacks=[events.append])
    assert done.metrics["iterations"] == DENSE.iterations
    assert not [event for event in events if isinstance(event, NoteEvent) and event.text.startswith("poses: ")]
