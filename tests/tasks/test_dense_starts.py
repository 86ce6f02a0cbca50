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
