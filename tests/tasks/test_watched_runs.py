"""Photos kept aside in whole runs of both tasks; test photos influence nothing."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.demo_scene import demo_scene
from etsplat.data.photograph import photograph
from etsplat.data.pictures import Picture, StoredPictures
from etsplat.io.run_directory import RunDirectory
from etsplat.optim.loop import CheckpointEvent, NoteEvent
from etsplat.report.cards import cards_of
from etsplat.report.data import read_run
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig

OBJECT = ReconstructConfig.tiny().changed(
    {
        "watch": None,
        "iterations": 60,
        "refinement.guard": 0.02,
        "refinement.subdivisions": 3,
        "refinement.untanglings": 2,
        "output.evaluate_every": 10,
        "output.checkpoint_every": 20,
        "output.chamfer_samples": 1000,
    }
)
# Steps of the vertices grow instead of falling, until the mesh goes to pieces.
WORSE = OBJECT.changed({"optimizer.lr_vertices_final": 100.0, "refinement.guard": 0.0})
SCENE = TrainConfig.tiny().changed({"iterations": 60, "output.evaluate_every": 20, "output.checkpoint_every": 30})


@pytest.fixture(scope="module")
def views() -> Dataset:
    return photograph(demo_object(), 32, 32, supersampling=1)


@pytest.fixture(scope="module")
def scene() -> Dataset:
    scene = demo_scene(48, 36)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    return replace(scene, exact_points=scene.exact_points[::20], point_colors=scene.point_colors[::20])


def with_test_photos_shuffled(dataset: Dataset) -> Dataset:
    """Each test view shows what the one before it showed."""
    turned = dict(zip(dataset.test, [dataset.test[-1], *dataset.test[:-1]], strict=True))
    pictures: list[Picture] = [dataset.images.picture(turned.get(index, index)) for index in range(len(dataset))]
    return replace(dataset, images=StoredPictures([p.pixels for p in pictures], [p.mask for p in pictures]))


def test_test_photos_influence_no_object(views: Dataset, tmp_path: Path) -> None:
    """With everything on that looks at photos besides the steps, shuffled ones leave the mesh's bits as they are."""
    first = reconstruct(views, tmp_path / "a", OBJECT)
    second = reconstruct(with_test_photos_shuffled(views), tmp_path / "b", OBJECT)
    assert (tmp_path / "a" / "mesh.ply").read_bytes() == (tmp_path / "b" / "mesh.ply").read_bytes()
    assert first.metrics["psnr"] != second.metrics["psnr"]
    assert first.metrics["watched_psnr"] == second.metrics["watched_psnr"]


@pytest.mark.parametrize("finish", ["none", "opaque"])
def test_test_photos_influence_no_scene(scene: Dataset, tmp_path: Path, finish: str) -> None:
    config = SCENE.changed({"finish": finish})
    first = train(scene, tmp_path / "a", config)
    second = train(with_test_photos_shuffled(scene), tmp_path / "b", config)
    for name, tensor in first.soup.state().items():
        assert torch.equal(tensor, second.soup.state()[name]), name
    assert first.metrics["psnr"] != second.metrics["psnr"]
    assert first.metrics["train_views"] + first.metrics["watched_views"] == len(scene.train)


def test_a_run_says_how_its_watched_photos_are(views: Dataset, tmp_path: Path) -> None:
    """In the history at every evaluation, in its metrics and on a card; 2 of 32 photos are kept from training."""
    result = reconstruct(views, tmp_path, OBJECT)
    lines = [line for line in RunDirectory(tmp_path).read_history() if "psnr" in line]
    assert [line["iteration"] for line in lines] == [10, 20, 30, 40, 50, 60]
    assert all({"watched_psnr", "watched_loss"} <= line.keys() for line in lines)
    assert result.metrics["watched_views"] == 2
    assert result.metrics["watched_psnr_last"] == lines[-1]["watched_psnr"]
    card = next(card for card in cards_of(read_run(tmp_path)) if card.title == "PSNR of watched photos")
    assert card.value == f"{result.metrics['watched_psnr']:.2f}"


def test_a_run_that_got_worse_returns_its_best_state(views: Dataset, tmp_path: Path) -> None:
    """With a note, in the metrics and the report; killed after the best state and resumed it is the same to the bit."""
    notes: list[str] = []

    def listen(event: object) -> None:
        if isinstance(event, NoteEvent):
            notes.append(event.text)

    result = reconstruct(views, tmp_path / "whole", WORSE, callbacks=[listen])
    found = result.metrics
    assert found["result_iteration"] < found["iterations"] == 60
    assert found["watched_psnr"] > found["watched_psnr_last"] + 0.25
    assert len(notes) == 1
    assert "the run got worse towards its end: the 2 photos kept aside had" in notes[0]
    card = next(card for card in cards_of(read_run(tmp_path / "whole")) if card.title == "PSNR of watched photos")
    assert f"the result is of iteration {found['result_iteration']}" in card.meaning

    def kill(event: object) -> None:
        if isinstance(event, CheckpointEvent) and event.iteration == 40:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        reconstruct(views, tmp_path / "killed", WORSE, callbacks=[kill])
    for _ in range(2):  # the second time the run is done
        resumed = reconstruct(views, tmp_path / "killed", WORSE, resume=True)
        assert (tmp_path / "killed" / "mesh.ply").read_bytes() == (tmp_path / "whole" / "mesh.ply").read_bytes()
        assert resumed.metrics["watched_psnr"] == found["watched_psnr"]


def test_photos_of_a_mesh_are_kept_aside_only_where_it_is_asked_for(tmp_path: Path) -> None:
    """They cost too much of the result, and the mesh itself says how good it is."""
    short = OBJECT.changed({"iterations": 2, "resolution": 24})
    assert "watched_views" not in reconstruct(demo_object(), tmp_path / "a", short).metrics
    asked = reconstruct(demo_object(), tmp_path / "b", short.changed({"watch": 8}))
    assert asked.metrics["watched_views"] == 4


def test_keeping_more_aside_than_there_is_room_for_is_refused(views: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="watch: one in 33 of 32 training photos would be none"):
        reconstruct(views, tmp_path / "run", OBJECT.changed({"watch": 33}))
    for config in (OBJECT, SCENE):
        with pytest.raises(InputError, match="watch: 1 would keep all photos from training"):
            config.changed({"watch": 1})
