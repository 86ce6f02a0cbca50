"""What a data set that is built in memory takes, and what it refuses by name."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import etsplat
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.doubtful_poses import doubts
from etsplat.data.pictures import StoredPictures
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig

PHOTO = torch.zeros(6, 8, 3, dtype=torch.uint8)


def dataset(**changes: Any) -> Dataset:
    around = etsplat.orbit_cameras(8, 6, elevations=(10.0,), azimuths=3)
    fields = {"viewmats": around.viewmats, "Ks": around.Ks, "images": StoredPictures([PHOTO] * 3), "names": list("abc")}
    return Dataset(**{**fields, "train": [0, 1], "test": [2], **changes})


def test_poses_and_splits_of_any_kind_become_what_runs_need():
    """Single precision and arrays are taken."""
    made = dataset(train=np.array([0, 1]), test=torch.tensor([2]), names=np.array(["a", "b", "c"]))
    assert made.names == ["a", "b", "c"]
    assert made.viewmats.dtype == made.Ks.dtype == torch.float64
    assert made.train == [0, 1]
    assert made.test == [2]
    points = dataset(exact_points=torch.rand(4, 3), point_colors=torch.rand(4, 3, dtype=torch.float64))
    assert points.exact_points is not None
    assert points.point_colors is not None
    assert (points.exact_points.dtype, points.point_colors.dtype) == (torch.float64, torch.float32)


def _scaled(viewmats: torch.Tensor) -> torch.Tensor:
    return viewmats * torch.tensor([2.0, 2, 2, 1])[:, None]


def _mirrored(viewmats: torch.Tensor) -> torch.Tensor:
    return viewmats * torch.tensor([-1.0, 1, 1, 1])[:, None]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_scaled, r"viewmats\[0\].*is no rotation"),
        (_mirrored, r"viewmats\[0\].*is mirrored"),
        (lambda viewmats: viewmats.mT, r"viewmats\[0\].*transposed"),
        (lambda viewmats: viewmats * torch.nan, "viewmats must be finite"),
        (lambda viewmats: viewmats[:, :3], r"viewmats must have shape \(B, 4, 4\)"),
        (lambda viewmats: viewmats.numpy(), "torch.from_numpy"),
    ],
)
def test_poses_that_are_none_are_refused(spoil, message):
    """By the first of them."""
    with pytest.raises(ValueError, match=message):
        dataset(viewmats=spoil(dataset().viewmats))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Ks": torch.zeros(3, 3, 3)}, r"Ks\[0\]: focal lengths"),
        ({"Ks": torch.eye(3).expand(3, 3, 3) + torch.eye(3).roll(1, 1) / 9}, r"Ks\[0\]: .*skew is not supported"),
        ({"Ks": 2 * torch.eye(3).expand(3, 3, 3)}, r"Ks\[0\]: must have the form"),
        ({"images": [PHOTO] * 3}, "images must be Pictures, got list"),
        ({"names": list("aba")}, "names: expected another one"),
        ({"names": None}, "names: expected a list of 3, one per viewmat, got None"),
        ({"names": "abc"}, "names: expected a list of 3, one per viewmat, got 'abc'"),
        ({"train": [0, 3]}, r"train: expected indices in \[0, 3\), got 3"),
        ({"train": "abc"}, r"train: expected indices in \[0, 3\), got 'abc'"),
        ({"test": None}, r"test: expected indices in \[0, 3\), got None"),
        ({"train": [0.5]}, r"train: expected indices in \[0, 3\), got 0\.5"),
        ({"train": [1.0]}, r"train: expected indices in \[0, 3\), got 1\.0"),
        ({"train": 1}, r"train: expected indices in \[0, 3\), got 1"),
        ({"train": [True, False, True]}, r"got True: of a mask of all views pass the indices"),
        ({"train": torch.tensor([False, True, True])}, r"of a mask of all views pass the indices"),
        ({"exact_points": torch.zeros(0, 3)}, "exact_points: expected at least one"),
        ({"exact_points": torch.full((2, 3), torch.inf)}, "exact_points must be finite"),
        ({"exact_points": torch.zeros(2, 3), "point_colors": torch.zeros(3, 3)}, "point_colors must have shape"),
        ({"exact_points": torch.zeros(2, 3), "point_colors": torch.zeros(2, 3).byte()}, "divide bytes by 255"),
        ({"exact_points": torch.zeros(2, 3), "point_colors": torch.full((2, 3), 9.0)}, r"must be in \[0, 1\]"),
    ],
)
def test_other_fields_that_are_wrong_are_named(changes, message):
    """Before a run begins."""
    with pytest.raises(ValueError, match=message):
        dataset(**changes)


def test_only_views_that_there_are_can_be_chosen():
    """Also by numbers of numpy and torch."""
    for views in ([99], [-1], "a", None):
        with pytest.raises(ValueError, match=r"views: expected indices in \[0, 3\), got"):
            dataset().of_views(views)
    assert dataset().of_views(torch.tensor([2, 0])).names == dataset().of_views([2, 0]).names


def test_no_gradients_reach_what_was_measured():
    """A run would walk through the caller's graph in every step. What rounding leaves of skew is taken out."""
    turned = (dataset().viewmats.clone().requires_grad_() * 1.0).float()
    made = dataset(viewmats=turned, Ks=dataset().Ks.clone().requires_grad_())
    assert not made.viewmats.requires_grad
    assert not made.Ks.requires_grad
    drawn = (torch.rand(6, 8, 3, 3).requires_grad_() * 0.5)[..., 0]
    assert not dataset(images=StoredPictures([drawn] * 3)).images[0].requires_grad
    assert not dataset(images=etsplat.LazyPictures(lambda view: drawn, [(8, 6)] * 3)).images[0].requires_grad
    rounded = dataset(Ks=dataset().Ks + 1e-9 * torch.eye(3).roll(1, 1))
    assert torch.equal(rounded.Ks[:, 0, 1], torch.zeros(3, dtype=torch.float64))


def test_a_data_set_is_moved_by_any_three_numbers():
    for center in (torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), (1, 2, 3), np.array([1.0, 2.0, 3.0])):
        moved = dataset().renormalized(center, np.float32(2.0))
        assert moved.normalization.center.tolist() == [1.0, 2.0, 3.0]
        assert moved.viewmats.equal(dataset().renormalized(torch.tensor([1.0, 2.0, 3.0]).double(), 2.0).viewmats)


@pytest.mark.parametrize(
    ("moved", "message"),
    [
        (lambda: dataset().renormalized((0, 0), 1.0), "center must be a tensor of shape"),
        (lambda: dataset().renormalized(torch.zeros(3), 0), "radius must be positive and finite, got 0"),
        (lambda: dataset().watching("2"), "one_in must be an integer of at least 0, got '2'"),
        (lambda: dataset().watching(2.5), r"one_in must be an integer of at least 0, got 2\.5"),
    ],
)
def test_numbers_that_say_nothing_of_a_data_set_are_named(moved, message):
    with pytest.raises(ValueError, match=message):
        moved()


def test_masks_of_three_kinds_are_the_same():
    """Booleans, floats, and bytes with 255."""
    inside = torch.arange(48).reshape(6, 8) % 3 == 0
    for mask in (inside, inside.float(), inside.byte() * 255):
        stored = StoredPictures([PHOTO], masks=[mask]).mask(0)
        assert stored is not None
        assert torch.equal(stored, inside.byte() * 255)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"masks": [torch.ones(6, 8, dtype=torch.uint8)]}, r"masks\[0\] has 0 and 1 alone"),
        ({"masks": [torch.full((6, 8), 255.0)]}, r"masks\[0\] must be in \[0, 1\]"),
        ({"masks": [torch.ones(6, 8, dtype=torch.int64)]}, r"masks\[0\] must be of booleans"),
        ({"masks": [torch.ones(8, 6).bool()]}, r"masks\[0\] must have shape \(6, 8\)"),
        ({"masks": []}, "masks: expected 1, one for each photo, got 0"),
        ({"pixels": [PHOTO.movedim(2, 0)]}, r"pixels\[0\] must have shape"),
        ({"pixels": [PHOTO.numpy()]}, r"pixels\[0\].*torch.from_numpy"),
        ({"pixels": [PHOTO.double()]}, r"pixels\[0\] must be uint8 or float32"),
        ({"pixels": [torch.full((6, 8, 3), 200.0)]}, r"pixels\[0\] must be in \[0, 1\]"),
        ({"pixels": [torch.full((6, 8, 3), torch.nan)]}, r"pixels\[0\] must be in \[0, 1\]"),
    ],
)
def test_pictures_that_are_none_are_refused(arguments, message):
    """With what to do, where it is plain."""
    with pytest.raises(ValueError, match=message):
        StoredPictures(**{"pixels": [PHOTO], **arguments})


def test_photos_that_are_not_premultiplied_are_spoken_of():
    """Bytes and floats; premultiplied ones are not."""
    straight = torch.full((6, 8, 4), 0.5)
    straight[..., 3] = 0.0
    for photo in (straight, (straight * 255).byte()):
        made = dataset(images=StoredPictures([PHOTO, photo, PHOTO]))
        assert "colours above their alpha in b: photos with alpha must be premultiplied, rgb * alpha" in doubts(made)
    assert "alpha" not in str(doubts(dataset(images=StoredPictures([straight * straight[..., 3:]] * 3))))


def test_masks_that_leave_out_everything_are_refused(tmp_path):
    """A run would have nothing to fit to, and perfect scores."""
    masks = [torch.zeros(6, 8).bool()] * 3
    made = dataset(images=StoredPictures([PHOTO] * 3, masks), exact_points=torch.rand(200, 3))
    with pytest.raises(InputError, match="masks: leave out every pixel of all training photos"):
        train(made, tmp_path / "run", TrainConfig.tiny().changed({"iterations": 2}))


@pytest.mark.parametrize("folder", ["images", "masks", "depths"])
def test_folders_of_pictures_belong_to_scene_folders(folder, tmp_path):
    """Not to what is in memory already, nor to the demo: they would have no effect."""
    config = TrainConfig.tiny().changed({"iterations": 2})
    for source in (dataset(), "demo:scene"):
        with pytest.raises(InputError, match=f"{folder} no_such: belong to a folder with posed images"):
            train(source, tmp_path / "run", config, **{folder: "no_such"})
    if folder == "masks":
        with pytest.raises(InputError, match="belong to a folder with posed images"):
            reconstruct(dataset(), tmp_path / "run", masks="no_such")


def test_a_schedule_names_what_a_model_has():
    """Misspelt names would have no effect, and rates that are missing are asked for."""
    photos = etsplat.photograph(etsplat.demo_object(), 12, 12, elevations=(0.0,), azimuths=3, supersampling=1)
    objective = etsplat.Objective(etsplat.Photometric())
    for schedule, message in (
        (etsplat.Schedule({**sphere().rates, "vertex": 1.0}), "rates names vertex; the model has vertices"),
        (etsplat.Schedule({"vertices": 0.1}), "rates has none for colors"),
        (etsplat.Schedule(sphere().rates, values={"sigma": 1.0}), "values names sigma"),
    ):
        with pytest.raises(ValueError, match=message):
            etsplat.Trainer(sphere(), photos, objective, schedule=schedule)
    with pytest.raises(ValueError, match="no view in `train`"):
        etsplat.Trainer(sphere(), replace(photos, train=[]), objective)
    with pytest.raises(ValueError, match="batch must be an integer of at least 1"):
        etsplat.Trainer(sphere(), photos, objective, batch=0)
    with pytest.raises(ValueError, match="objective must be an Objective, got Photometric"):
        etsplat.Trainer(sphere(), photos, etsplat.Photometric())  # pyright: ignore[reportArgumentType]
    etsplat.Trainer(sphere(), photos, objective, background=(1, 1, 1)).fit(1)


def sphere() -> etsplat.TriangleMesh:
    return etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
