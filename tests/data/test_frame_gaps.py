"""A ball that the frame cuts off, with masks that end along the frame or just before it."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.changed_pictures import Box, cropped
from etsplat.data.dataset import Dataset
from etsplat.data.frame_gaps import without_frame_gaps
from etsplat.data.hull import bounding_sphere
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile

SIZE, CUT = 96, 30


@pytest.fixture(scope="module")
def whole() -> Dataset:
    return photograph(MeshFile(*icosphere(3)), SIZE, SIZE, supersampling=1)


@pytest.fixture(scope="module")
def cut(whole: Dataset) -> Dataset:
    """Every photo lacks a side, each another."""
    boxes = [
        (Box(CUT, 0, SIZE, SIZE), Box(0, CUT, SIZE, SIZE), Box(0, 0, SIZE - CUT, SIZE), Box(0, 0, SIZE, SIZE - CUT))[
            index % 4
        ]
        for index in range(len(whole))
    ]
    Ks = whole.Ks.clone()
    Ks[:, :2, 2] -= torch.tensor([[box.left, box.upper] for box in boxes])
    return replace(whole, Ks=Ks, images=cropped(whole.images, boxes))


def gaps_of_one(views: Dataset) -> Dataset:
    """The outermost pixel of each mask is empty."""
    images = [image.clone() for image in views.images]
    for image in images:
        image[[0, -1]] = 0
        image[:, [0, -1]] = 0
    return replace(views, images=StoredPictures(images))


def test_nothing_changes_where_masks_reach_the_frame_or_keep_off_it(whole: Dataset, cut: Dataset) -> None:
    for views in (whole, cut):
        assert without_frame_gaps(views) == (views, [])


def test_a_round_object_that_comes_near_to_the_frame_is_whole(whole: Dataset) -> None:
    first = whole.images[0][..., 3] >= 0.5
    rows, columns = first.any(dim=1).nonzero()[:, 0], first.any(dim=0).nonzero()[:, 0]
    tight = Box(int(columns[0]) - 1, int(rows[0]) - 1, int(columns[-1]) + 2, int(rows[-1]) + 2)
    views = replace(whole, images=cropped(whole.images, [tight] * len(whole)))
    assert without_frame_gaps(views)[1] == []


def test_gaps_are_cropped_and_what_is_left_is_where_it_was(cut: Dataset) -> None:
    views = gaps_of_one(cut)
    found, which = without_frame_gaps(views)
    assert which == list(range(len(cut)))
    for index in range(4):
        shift = (views.Ks[index] - found.Ks[index])[:2, 2].long().tolist()
        assert shift == [[1, 0], [0, 1], [0, 0], [0, 0]][index]
        width, height = found.images.sizes[index]
        kept = views.images[index][shift[1] : shift[1] + height, shift[0] : shift[0] + width]
        assert torch.equal(found.images[index], kept)
        side = [kept[:, 0], kept[0], kept[:, -1], kept[-1]][index]
        assert float(side[..., 3].mean()) > 0.3


def test_with_gaps_cropped_the_object_is_as_large_as_it_is(cut: Dataset) -> None:
    """Taken at their word such masks leave nothing beyond the frames: a third of the ball."""
    views = gaps_of_one(cut)
    assert bounding_sphere(views)[1] < 0.7
    center, radius = bounding_sphere(without_frame_gaps(views)[0])
    assert float(center.norm()) < 0.05
    assert radius == pytest.approx(bounding_sphere(cut)[1], abs=1e-6)
