"""Where a visual hull ends because photos do."""

from dataclasses import replace

import pytest
import torch
import trimesh

from etsplat.data.changed_pictures import Box, cropped
from etsplat.data.cut_off import cut_off
from etsplat.data.dataset import Dataset
from etsplat.data.photograph import photograph
from etsplat.data.visual_hull import visual_hull
from etsplat.io.mesh_files import MeshFile
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starts import start_shape


@pytest.fixture(scope="module")
def rod() -> Dataset:
    """It lies along x, four times as long as it is wide."""
    mesh = trimesh.creation.capsule(height=1.5, radius=0.25, count=(16, 16))
    vertices = torch.from_numpy(mesh.vertices.copy()).float()
    vertices -= (vertices.amin(dim=0) + vertices.amax(dim=0)) / 2
    return photograph(MeshFile(vertices.roll(1, dims=1), torch.from_numpy(mesh.faces.copy()).long()), 96, 96)


def cut_at(views: Dataset, x: float, some: slice = slice(None)) -> Dataset:
    """Photos whose frame ends where a plane across x is seen, if that is to the left or right of their middle."""
    ends = torch.tensor([x, 0.0, 0.0])
    boxes = [Box(0, 0, *size) for size in views.images.sizes]
    for index in views.train[some]:
        width, height = views.images.sizes[index]
        eye = views.viewmats[index, :3, :3].float() @ ends + views.viewmats[index, :3, 3].float()
        place = views.Ks[index].float() @ (eye / eye[2])
        column, row = round(float(place[0])), round(float(place[1]))
        if abs(column - width / 2) > abs(row - height / 2):
            left, right = (0, column) if column > width / 2 else (column, width)
            boxes[index] = Box(left, 0, right, height)
        else:
            upper, lower = (0, row) if row > height / 2 else (row, height)
            boxes[index] = Box(0, upper, width, lower)
    Ks = views.Ks.clone()
    Ks[:, :2, 2] -= torch.tensor([[box.left, box.upper] for box in boxes])
    return replace(views, Ks=Ks, images=cropped(views.images, boxes))


def share(views: Dataset) -> float:
    return cut_off(views, *visual_hull(views, 4000, radius=1.05))


def test_a_whole_object_is_not_cut_off(rod):
    assert share(rod) == 0


def test_an_end_that_no_photo_shows_is_found(rod):
    """A section of the rod: the area of a disc of all that is left of it. Runs start from that hull."""
    views = cut_at(rod, 0.5)
    assert 0.02 < share(views) < 0.12
    assert start_shape(ReconstructConfig.quick(), views) == "hull"


def test_what_half_of_the_photos_show_is_not_cut_off(rod):
    assert share(cut_at(rod, 0.5, slice(None, None, 3))) == 0


def test_of_nothing_nothing_is_cut_off(rod):
    assert cut_off(rod, torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64)) == 0
