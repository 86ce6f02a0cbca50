"""Views on a device, by index and by numbers in its memory."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.loader import ViewLoader
from etsplat.data.pictures import LazyPictures, Picture, StoredPictures

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Photos of two sizes and three types, some with masks."""
    scene = demo_scene(20, 16)
    photos = [image[:12] if index % 2 else image for index, image in enumerate(scene.images)]
    masks = [255 * (image[..., 0] > 90).to(torch.uint8) if index % 3 else None for index, image in enumerate(photos)]
    for index in range(0, len(photos), 5):
        alpha = torch.full((*photos[index].shape[:2], 1), 255, dtype=torch.uint8)
        photos[index] = torch.cat([photos[index], alpha], dim=-1)
        if index % 2:
            photos[index] = photos[index].float() / 255
    return replace(scene, images=StoredPictures(photos, masks))


@pytest.mark.parametrize("streamed", [False, True])
def test_a_view_is_the_same_by_index_and_by_place(dataset, streamed):
    """Its camera, photo and mask, whether all photos stay or each is brought before its step."""
    pictures = LazyPictures(
        lambda index: Picture(dataset.images[index], dataset.images.mask(index)),
        dataset.images.sizes,
        [20 * 16 * 4] * len(dataset),
        dataset.images.fingerprint,
        limit=5000 if streamed else 10**9,
    )
    loader = ViewLoader(replace(dataset, images=pictures), CPU)
    assert loader.streamed == streamed
    kinds = set()
    for index in dataset.train:
        loader.expect([index])
        kind, place = loader.kind_and_place(index)
        loader.upload(index)()
        kinds.add(kind)
        view, queued = loader.view(index), loader.look_up(kind, torch.tensor(place))
        for one, other in ((view.camera, dataset.cameras[index]), (queued.camera, dataset.cameras[index])):
            assert torch.equal(one.viewmats, other.viewmats)
            assert torch.equal(one.Ks, other.Ks)
            assert (one.width, one.height) == (other.width, other.height)
        for seen in (view, queued):
            assert seen.photo.dtype == dataset.images[index].dtype
            assert torch.equal(seen.photo[0], dataset.images[index])
            mask = dataset.images.mask(index)
            assert (seen.mask is None) == (mask is None)
            assert mask is None or torch.equal(seen.mask[0], mask)
    assert len(kinds) > 5


def test_streamed_views_of_one_step_lie_side_by_side(dataset):
    """Two photos of the same kind, both uploaded before either is looked at."""
    pictures = LazyPictures(
        lambda index: Picture(dataset.images[index], dataset.images.mask(index)),
        dataset.images.sizes,
        [20 * 16 * 4] * len(dataset),
        dataset.images.fingerprint,
        limit=5000,
    )
    loader = ViewLoader(replace(dataset, images=pictures), CPU, batch=2)
    kinds = {index: loader.kind_and_place(index)[0] for index in dataset.train}
    pair = next([a, b] for a in dataset.train for b in dataset.train if a < b and kinds[a] == kinds[b])
    places = [loader.kind_and_place(index, number)[1] for number, index in enumerate(pair)]
    for upload in [loader.upload(index, number) for number, index in enumerate(pair)]:
        upload()
    for index, place in zip(pair, places, strict=True):
        assert torch.equal(loader.look_up(kinds[index], torch.tensor(place)).photo[0], dataset.images[index])
