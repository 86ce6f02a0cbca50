"""What reconstructions start from: which shape is chosen, and that runs from each end as they should."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.photograph import photograph
from etsplat.data.pictures import Box, StoredPictures, cropped
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import genera
from etsplat.io.mesh_files import MeshFile
from etsplat.optim.loop import Event, NoteEvent
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starts import start_shape
from helpers.reconstructions import SHORT, KilledError, kill_at, pebble_mesh, untimed


@pytest.fixture(scope="module")
def pebble() -> MeshFile:
    return pebble_mesh()


def test_photos_start_from_the_hull_if_most_show_the_object_as_a_whole() -> None:
    """Those without transparency, and those of whose silhouettes no hull explains half, start from the sphere."""
    ball = MeshFile(*icosphere(2))
    views = photograph(ball, 48, 48, supersampling=1)
    config = ReconstructConfig.quick()

    def start(views: Dataset) -> str:
        return start_shape(config, views)

    assert start(views) == "hull"
    images = list(views.images)
    assert start(replace(views, images=StoredPictures([image[..., :3] for image in images]))) == "sphere"
    cut = [
        image.flip(0).roll(-20, dims=0) if index in views.train[::2] else image for index, image in enumerate(images)
    ]
    assert start(replace(views, images=StoredPictures(cut))) == "sphere"
    asked = ReconstructConfig.quick().changed({"start.shape": "sphere"})
    assert start_shape(asked, views) == "sphere"


def test_photos_that_together_show_all_of_an_object_start_from_the_hull() -> None:
    """Each is cut off at a side, and other photos show what it lacks; from the sphere that would stay where it is."""
    whole = photograph(MeshFile(*icosphere(2)), 48, 48, supersampling=1)
    boxes = [(Box(14, 0, 48, 48), Box(0, 0, 34, 48))[index % 2] for index in range(len(whole))]
    Ks = whole.Ks.clone()
    Ks[:, 0, 2] -= torch.tensor([float(box.left) for box in boxes])
    views = replace(whole, Ks=Ks, images=cropped(whole.images, boxes))
    assert start_shape(ReconstructConfig.quick(), views) == "hull"


def test_settings_of_one_start_are_taken_where_it_is_chosen_as_the_run_begins(tmp_path: Path) -> None:
    """With "auto" those of the sphere have an effect or not, as the photos are."""
    views = photograph(MeshFile(*icosphere(2)), 48, 48, supersampling=1)
    config = SHORT.changed({"iterations": 2, "start.shape": "auto", "start.level": 1, "start.near": 0.5})
    reconstruct(views, tmp_path, config)
    told = json.loads((tmp_path / "config.json").read_text())["config"]["start"]
    assert (told["shape"], told["level"], told["near"]) == ("auto", 1, 0.5)


def test_a_given_mesh_is_the_start(pebble: MeshFile, tmp_path: Path) -> None:
    """Started from the solution, in its own units and unwelded, a short run without subdivision stays close to it."""
    soup = MeshFile(pebble.vertices[pebble.faces].reshape(-1, 3), torch.arange(3 * len(pebble.faces)).reshape(-1, 3))
    config = SHORT.changed({"optimizer.lr_vertices": 1e-4, "max_faces": 100})
    result = reconstruct(pebble, tmp_path, config, init_mesh=soup)
    assert result.metrics["faces"] == len(pebble.faces)
    assert result.metrics["vertices"] == len(pebble.vertices)
    assert result.metrics["chamfer_exact"] < 1e-4


def test_a_start_from_the_hull_keeps_the_hole_and_ends_the_same_when_resumed(tmp_path: Path) -> None:
    """A torus: the sphere would span its hole; the hull has it, so the result is closed and of genus 1."""
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=32, minor_sections=16)
    source = MeshFile(torch.from_numpy(ring.vertices.copy()).float(), torch.from_numpy(ring.faces.copy()).long())
    config = SHORT.changed({"start.shape": "hull"})
    events: list[Event] = []
    whole = reconstruct(source, tmp_path / "whole", config, callbacks=[events.append])
    assert genera(whole.mesh.faces, len(whole.mesh.vertices)) == [1]
    assert any(isinstance(event, NoteEvent) and "holes in each part: [1]" in event.text for event in events)
    with pytest.raises(KilledError):
        reconstruct(source, tmp_path / "killed", config, callbacks=[kill_at(config.iterations // 2)])
    reconstruct(source, tmp_path / "killed", config, resume=True)
    assert untimed(tmp_path / "killed") == untimed(tmp_path / "whole")


def test_a_hull_needs_masks(pebble: MeshFile, tmp_path: Path) -> None:
    """Pictures without transparency are no silhouettes."""
    views = photograph(pebble, 48, 48, supersampling=1)
    opaque = [image[..., :3] for image in views.images]
    config = SHORT.changed({"start.shape": "hull"})
    with pytest.raises(InputError, match="needs masks"):
        reconstruct(replace(views, images=StoredPictures(opaque)), tmp_path, config)
