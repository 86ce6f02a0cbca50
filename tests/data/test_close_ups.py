"""A ball in the midst of much background."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.close_ups import close_ups, cropped_to, object_side
from etsplat.data.dataset import Dataset
from etsplat.data.hull import bounding_sphere
from etsplat.data.photograph import photograph
from etsplat.data.photos import reduced
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile

SIZE, ROOM = 96, 200


@pytest.fixture(scope="module")
def near() -> Dataset:
    return photograph(MeshFile(*icosphere(3)), SIZE, SIZE, supersampling=1, azimuths=4)


def from_afar(views: Dataset) -> Dataset:
    """The same object in the same pixels, with so many more of background on each side."""
    images = [torch.nn.functional.pad(image, (0, 0, ROOM, ROOM, ROOM, ROOM)) for image in views.images]
    Ks = views.Ks.clone()
    Ks[:, :2, 2] += ROOM
    return replace(views, Ks=Ks, images=StoredPictures(images))


@pytest.fixture(scope="module")
def far(near: Dataset) -> Dataset:
    return from_afar(near)


def test_photos_are_halved_for_what_they_show_of_the_object_not_for_what_is_around_it(near: Dataset, far: Dataset):
    assert 80 < object_side(far) == object_side(near) <= 90
    for longest, halvings in ((100, 0), (50, 1), (30, 2)):
        for views in (near, far):
            found = reduced(views, longest)
            assert float(views.Ks[0, 0, 0] / found.Ks[0, 0, 0]) == pytest.approx(2**halvings)


def test_a_small_object_gets_close_ups_of_one_size_and_a_large_one_none(near: Dataset, far: Dataset) -> None:
    assert close_ups(near) is None
    boxes = close_ups(far)
    assert boxes is not None
    found = cropped_to(far, boxes, far.images.sizes)
    assert len(set(found.images.sizes)) == 1
    assert found.images.sizes[0][0] == pytest.approx(1.3 * object_side(near), abs=1)
    assert all(found.images[view][..., 3].sum() == near.images[view][..., 3].sum() for view in range(len(near)))
    center, radius = bounding_sphere(found)
    expected, wide = bounding_sphere(near)
    torch.testing.assert_close(center, expected)
    assert radius == pytest.approx(wide, abs=0.02)
    assert close_ups(found) is None


def test_boxes_are_carried_over_to_photos_of_another_size(far: Dataset) -> None:
    small = far.halved()
    boxes = close_ups(small)
    assert boxes is not None
    found = cropped_to(far, boxes, small.images.sizes)
    assert found.images.sizes[0] == tuple(2 * side for side in (boxes[0].right - boxes[0].left,) * 2)
    for view in range(len(far)):
        assert found.images[view][..., 3].sum() == far.images[view][..., 3].sum()


def test_photos_that_may_cut_the_object_off_stay_whole_and_blobs_of_masks_stay(near: Dataset, far: Dataset) -> None:
    images = [image.clone() for image in far.images]
    images[0][2:9, 240:250] = 1.0  # ends before the frame, as masks may
    images[1][40:50, 240:250] = 1.0
    views = replace(far, images=StoredPictures(images))
    boxes = close_ups(views)
    assert boxes is not None
    found = cropped_to(views, boxes, views.images.sizes)
    assert found.images.sizes[0] == views.images.sizes[0]
    assert all(found.images[view][..., 3].sum() == images[view][..., 3].sum() for view in range(len(near)))


def test_where_masks_are_empty_nothing_is_cropped(far: Dataset) -> None:
    assert close_ups(replace(far, images=StoredPictures([torch.zeros_like(image) for image in far.images]))) is None
