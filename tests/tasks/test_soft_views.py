"""Views of a soft soup between and beyond photos, for its opaque mesh to be fitted to."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.exposure import Exposure
from etsplat.optim.loop import Event, StageEvent
from etsplat.optim.schedules import NEVER
from etsplat.tasks import opaque, soft_views
from etsplat.tasks.opaque import make_opaque_trainer, opaque_mesh, start_mesh
from etsplat.tasks.soft_views import EPOCHS, with_soft_views
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import small_demo_scene
from helpers.reconstructions import KilledError

BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def few() -> Dataset:
    """Five photos to train on, two to test."""
    scene = small_demo_scene()
    return scene.of_views([*scene.train[:5], *scene.test[:2]])


def soup_of(capture: Dataset) -> TriangleSoup:
    assert capture.points is not None
    assert capture.point_colors is not None
    corners = capture.points[:, None] + 0.1 * torch.randn(400, 3, 3, generator=torch.Generator().manual_seed(1))
    return TriangleSoup.from_triangles(corners.float(), capture.point_colors, opacity=0.7, sigma=0.3, sh_degree=0)


def test_they_are_what_the_soup_shows_from_elsewhere(few: Dataset) -> None:
    """As many as each view, a photo or not, is seen five times; the photos are the first, and none is tested by."""
    soup = soup_of(few)
    views = with_soft_views(few, soup, EPOCHS * 12 + 3, (1.0, 1.0, 1.0), seed=0)
    assert views.train == [*few.train, *range(len(few), len(few) + 7)]
    assert (views.test, views.watched) == (few.test, few.watched)
    for index in range(len(few)):
        assert torch.equal(views.images[index], few.images[index])
        assert torch.equal(views.viewmats[index], few.viewmats[index])
    for index in views.train[5:]:
        camera = views.cameras[index]
        assert torch.equal(camera.Ks[0].double(), few.Ks[0])
        expected = soup.render(camera, backgrounds=torch.ones(3)).color[0].detach()
        assert float((views.images[index].float() / 255 - expected.clamp(0, 1)).abs().max()) < 0.51 / 255
        assert min(float((views.centers[index] - center).norm()) for center in few.centers) > 1e-3


def test_of_photos_with_alpha_they_have_alpha(few: Dataset) -> None:
    cut_out = [torch.nn.functional.pad(pixels, (0, 1), value=255) for pixels in few.images]
    capture, soup = replace(few, images=StoredPictures(cut_out)), soup_of(few)
    views = with_soft_views(capture, soup, EPOCHS * 6, (1.0, 1.0, 1.0), seed=0)
    drawn = soup.render(views.cameras[-1])
    expected = torch.cat([drawn.color[0], drawn.alpha[0]], dim=-1).detach()
    assert float((views.images[-1].float() / 255 - expected.clamp(0, 1)).abs().max()) < 0.51 / 255
    assert not views.images.straight


def test_many_photos_leave_no_room_for_them(few: Dataset) -> None:
    assert with_soft_views(few, soup_of(few), EPOCHS * 5, BLACK, seed=0) is few


def test_they_take_no_more_memory_than_they_may(few: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soft_views, "MOST_PIXELS", 3 * 64 * 48)
    assert len(with_soft_views(few, soup_of(few), 1000, BLACK, seed=0)) == len(few) + 3


def test_they_are_neutral_where_photos_have_exposures_and_photos_alone_judge(few: Dataset) -> None:
    """What the run has learned of its photos holds for these; the strategy sees no others."""
    own, config = few.normalized(), TrainConfig.tiny()
    known = Exposure.of("on", 10, 5)
    known.start(own.train, 1, torch.zeros(1))
    learned = {"values": 0.1 * torch.ones(5, 10), "first": torch.ones(5, 10), "second": torch.ones(5, 10)}
    known.load_state({"explained": torch.tensor(0.5), **learned, "step_count": torch.tensor(7)})
    soup = soup_of(own)
    views = with_soft_views(own, soup, EPOCHS * 8, BLACK, seed=0)
    exposure = start_mesh(soup, known, own, views, config).exposure
    assert exposure.learned
    assert exposure.next_measurement(0) == NEVER
    matrices = exposure.matrices()
    assert list(matrices) == views.train
    for view in own.train:
        torch.testing.assert_close(matrices[view], known.matrices()[view])
    for view in views.train[5:]:
        assert torch.equal(matrices[view], torch.eye(3))


def test_photos_alone_are_fitted_to_at_last(few: Dataset) -> None:
    """While colours settle, in the last three tenths of the steps."""
    soup = soup_of(few)
    views = with_soft_views(few, soup, EPOCHS * 8, BLACK, seed=0)
    trainer = make_opaque_trainer(
        opaque_mesh(soup),
        views,
        photos=few,
        iterations=20,
        unit=1.0,
        carried=400,
        max_faces=400,
        background=BLACK,
    )
    shown = list[set[int]]()
    sampler = trainer._stepper.sampler

    def seen(_: int) -> None:
        shown.append(set(sampler._views.tolist()))

    trainer.onlooker = seen
    trainer.fit(20)
    assert shown == [set(views.train)] * 14 + [set(few.train)] * 6


@pytest.mark.parametrize("done", [0, 7, 13])
def test_a_run_with_them_ends_with_the_same_bits_after_a_kill(
    few: Dataset, done: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its views are drawn anew, from the soup that is there again."""
    changes = {"asset": True, "iterations": 120, "max_triangles": 900, "output.checkpoint_every": 5}
    config = TrainConfig.tiny().changed(changes)

    def kill(event: Event) -> None:
        if isinstance(event, StageEvent) and event.name == "Fitting the opaque mesh" and event.done >= done:
            raise KilledError

    drawn: list[int] = []

    def with_views(capture: Dataset, *others: Any, **named: Any) -> Dataset:
        views = with_soft_views(capture, *others, **named)
        drawn.append(len(views) - len(capture))
        return views

    monkeypatch.setattr(opaque, "with_soft_views", with_views)
    train(few, tmp_path / "whole", config, callbacks=[lambda event: None])
    with pytest.raises(KilledError):
        train(few, tmp_path / "killed", config, callbacks=[kill])
    train(few, tmp_path / "killed", config, resume=True, callbacks=[lambda event: None])
    whole, killed = (RunDirectory(tmp_path / name).opaque_path.read_bytes() for name in ("whole", "killed"))
    assert whole == killed
    assert drawn == [3, 3, 3]
