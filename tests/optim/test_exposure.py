"""Gains and white balances that photos were given are found again, on every engine; where there are none, nothing."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat.core.rasterization import Rasterization
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.loader import View
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures, as_float
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.io.run_directory import RunDirectory
from etsplat.metrics.image import psnr
from etsplat.model.soup_init import StartPoints, start_soup
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.exposure import Exposure, share_of_their_own
from etsplat.optim.loop import StepEvent
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import NEVER, Schedule, exponential_decay
from etsplat.optim.strategies import DensifyAndPrune
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.terms.soup import Opacity
from etsplat.optim.trainer import Trainer
from helpers.engines import device_of
from helpers.trainers import OnEngine, same_bits

GAIN = 0.12
"""Standard deviation of the logarithms; of a channel's beside the others half of it."""


@pytest.fixture(scope="module")
def views() -> Dataset:
    """A ball of many colours, dimmed, so that no gain clips. Its faces are larger than pixels."""
    bright = photograph(ball(), 32, 32, elevations=(-35.0, 0.0, 35.0), azimuths=8, supersampling=2)
    return shot(bright, torch.full((len(bright), 3), 0.5), bright.train + bright.test)


def ball() -> MeshFile:
    vertices, faces = icosphere(2)
    colors = torch.rand((len(faces), 3), generator=torch.Generator().manual_seed(8))
    return MeshFile(vertices, faces, face_colors=0.6 + 0.4 * colors)


@pytest.fixture(scope="module")
def gains(views: Dataset) -> Tensor:
    """(B, 3) by view, with a mean of 0 in the logarithm over the training views."""
    rng = torch.Generator().manual_seed(4)
    logs = GAIN * torch.randn(len(views), 1, generator=rng) + GAIN / 2 * torch.randn(len(views), 3, generator=rng)
    return (logs - logs[views.train].mean(dim=0)).exp()


def shot(dataset: Dataset, gains: Tensor, views: list[int]) -> Dataset:
    """The same with the colours of some photos multiplied by the gains (B, 3) of their views."""
    pixels = []
    for index, image in enumerate(dataset.images):
        photo = as_float(image).clone()
        if index in views:
            photo[..., :3] *= gains[index]
        pixels.append((photo.clamp_max(1) * 255 + 0.5).byte() if image.dtype == torch.uint8 else photo)
    masks = [dataset.images.mask(index) for index in range(len(dataset))]
    return replace(dataset, images=StoredPictures(pixels, masks))


def falling(iteration: int, length: int) -> float:
    """A rate that lets colours come to rest."""
    return 5e-2 * exponential_decay(iteration, length, 0.02)


def true_shape(dataset: Dataset, exposure: Exposure | None, length: int = 600, **options: Any) -> Trainer[TriangleMesh]:
    """Colours alone are learned, on the surface that the photos show."""
    frame, shape = dataset.normalization, ball()
    mesh = TriangleMesh.from_mesh(frame.apply(shape.vertices).float(), shape.faces, colors=0.5, opacity=0.98, sigma=0.1)
    colors = partial(falling, length=length)
    rates = Schedule({"vertices": 0.0, "colors": colors, "opacity_logits": 0.0, "log_sigma": 0.0})
    return Trainer(mesh, dataset, Objective(Photometric()), schedule=rates, exposure=exposure, **options)


def neutral_psnr(trainer: Trainer[Any], dataset: Dataset) -> float:
    """Of the test views as they are."""
    black, scores = torch.zeros(1, 3), []
    for index in dataset.test:
        with torch.no_grad():
            picture = trainer.model.render(dataset.cameras[index], backgrounds=black).color[0].clamp(0, 1)
        scores.append(psnr(picture, as_float(dataset.images[index])[..., :3]))
    return sum(scores) / len(scores)


def of_greys(exposure: Exposure) -> Tensor:
    """(P, 3) what became of grey in each photo."""
    return torch.stack([matrix.sum(dim=1) for matrix in exposure.matrices().values()])


def test_gains_and_white_balances_are_found_again(views: Dataset, gains: Tensor) -> None:
    """Within a few percent; the model is as good as that of photos with one exposure, and without much worse."""
    spoiled = shot(views, gains, views.train)
    fits = {
        "even": true_shape(views, None),
        "off": true_shape(spoiled, None),
        "auto": true_shape(spoiled, Exposure.of("auto", 600, 12)),
    }
    scores = {}
    for name, trainer in fits.items():
        trainer.fit(600)
        scores[name] = neutral_psnr(trainer, views)
    exposure = fits["auto"].exposure
    assert exposure.learned
    assert exposure.explained is not None
    assert exposure.explained > 0.1
    assert scores["auto"] > scores["even"] - 0.3
    assert scores["off"] < scores["even"] - 2.5
    ratio = (of_greys(exposure) / gains[views.train]).log()
    assert float(gains[views.train].log().square().mean().sqrt()) > 0.1
    assert float((ratio - ratio.mean(dim=0)).square().mean().sqrt()) < 0.01


def test_photos_that_are_alike_are_left_as_they_are(views: Dataset) -> None:
    """The measurement changes no bit of the run, and finds nothing."""
    plain, measured = true_shape(views, None), true_shape(views, Exposure(60))
    losses = [[event.loss for event in events_of(trainer, 80)] for trainer in (plain, measured)]
    assert losses[0] == losses[1]
    assert not measured.exposure.learned
    assert measured.exposure.explained is not None
    assert -0.1 < measured.exposure.explained < 0.05
    state = measured.state()
    assert float(state.pop("exposure.explained")) == measured.exposure.explained
    assert [name for name, tensor in plain.state().items() if not torch.equal(tensor, state.pop(name))] == []
    assert not state


def events_of(trainer: Trainer[Any], iterations: int, **options: Any) -> list[StepEvent]:
    """Of every iteration."""
    events: list[object] = []
    trainer.fit(iterations, callbacks=[events.append], log_every=1, **options)
    return [event for event in events if isinstance(event, StepEvent)]


def test_the_mean_photo_is_neutral_after_every_step(views: Dataset, gains: Tensor) -> None:
    """Whatever the photos have in common is the model's."""
    trainer = true_shape(shot(views, 1.5 * gains, views.train), Exposure(2, needed=-1.0), batch=2)
    values = trainer.exposure.values
    for iteration in range(1, 31):
        trainer.advance(iteration, iteration)
        trainer.refine(iteration)
        assert float(values.detach().mean(dim=0).abs().max()) < 1e-6
    assert float(values.detach().abs().max()) > 0.01


@pytest.mark.parametrize("channels", [3, 4])
def test_of_a_masked_photo_the_object_alone_is_exposed(views: Dataset, channels: int) -> None:
    """C + (1 - A) b becomes M C + (1 - A) b; without transparency the whole picture does."""
    exposure = Exposure(NEVER)
    exposure.start([2, 5], 1, torch.zeros(()))
    with torch.no_grad():
        exposure.values.copy_(0.1 * torch.randn((2, 10), generator=torch.Generator().manual_seed(0)))
    rng = torch.Generator().manual_seed(1)
    part, alpha, behind = (torch.rand(size, generator=rng) for size in ((1, 4, 5, 3), (1, 4, 5, 1), (1, 3)))
    seen = Rasterization(part * alpha + (1 - alpha) * behind, alpha)
    view = View(views.cameras[0], torch.zeros(1, 4, 5, channels), None, torch.tensor([5]))
    matrix = exposure.matrices()[5]
    gain, offsets = exposure.values[1].detach().split([1, 9])
    torch.testing.assert_close(matrix, gain.exp() * (torch.eye(3) + offsets.view(3, 3)))
    expected = (part * alpha) @ matrix.T + (1 - alpha) * (behind @ matrix.T if channels == 3 else behind)
    torch.testing.assert_close(exposure.applied(seen, view, behind).color.detach(), expected)


@pytest.mark.parametrize("killed_at", [8, 27])
def test_a_resumed_run_ends_with_the_same_bits(views: Dataset, gains: Tensor, tmp_path: Path, killed_at: int) -> None:
    """Killed before photos are measured, which is after 20 iterations, and after it."""
    spoiled = shot(views, gains, views.train)

    def make() -> Trainer[TriangleMesh]:
        return true_shape(spoiled, Exposure.of("auto", 200, 1))

    def kill(event: object) -> None:
        if isinstance(event, StepEvent) and event.iteration == killed_at:
            raise RuntimeError("killed")

    whole = make()
    losses = [event.loss for event in events_of(whole, 40)]
    run = RunDirectory.create(tmp_path / "run", {"task": "fit"})
    with pytest.raises(RuntimeError, match="killed"):
        make().fit(40, callbacks=[kill], log_every=1, checkpoint_every=5, run=run)
    resumed = make()
    assert [event.loss for event in events_of(resumed, 40, run=run)] == losses[killed_at // 5 * 5 :]
    assert resumed.exposure.learned
    state, expected = resumed.state(), whole.state()
    assert [name for name in expected if not torch.equal(state[name], expected[name])] == []
    assert resumed.exposure.explained == whole.exposure.explained


@pytest.fixture(scope="module")
def scene(gains: Tensor) -> Dataset:
    """Photos of two sizes, some with an alpha channel, each with a gain of its own."""
    scene = demo_scene(40, 32)
    pixels = [image[:24] if index % 2 else image for index, image in enumerate(scene.images)]
    for index in range(0, len(pixels), 4):
        alpha = torch.full((*pixels[index].shape[:2], 1), 255, dtype=torch.uint8)
        pixels[index] = torch.cat([pixels[index], alpha], dim=-1)
    scene = replace(scene, images=StoredPictures(pixels))
    rng = torch.Generator().manual_seed(6)
    return shot(scene, (0.3 * torch.randn(len(scene), 3, generator=rng) - 0.3).exp(), scene.train)


def on_engine(scene: Dataset, engine: str, batch: int = 1, choice: Any = "auto") -> OnEngine:
    """Photos are measured after iteration 2; triangles come after iteration 4."""
    assert scene.points is not None
    points = scene.points[::150]
    rng = torch.Generator().manual_seed(3)
    start = StartPoints(points, torch.full_like(points, 0.5))
    soup = start_soup(start, rng, scale=2.0, opacity=0.4, sigma=1.0, sh_degree=1).to(torch.device(device_of(engine)))
    objective = Objective(Photometric(0.2), [Opacity(0.005)])
    strategy = DensifyAndPrune(begin=3, every=4, max_triangles=300)
    exposure = Exposure.of(choice, 20, 0)
    return OnEngine(engine, lambda: Trainer(soup, scene, objective, strategy, exposure=exposure, batch=batch))


def test_it_is_learned_alike_on_every_engine(engine: str, scene: Dataset) -> None:
    """What each photo got after a few steps, beside the reference."""
    ours, reference = (on_engine(scene, name, choice="on") for name in (engine, "reference"))
    for trainer in (ours, reference):
        trainer.run(4)
    found, expected = ours.trainer.exposure, reference.trainer.exposure
    values, wanted = (each.values.detach().cpu() for each in (found, expected))
    assert float(wanted.abs().max()) > 0.005
    # Signs of gradients near zero differ, and Adam takes a whole step for each.
    assert float(((values - wanted).abs() < 1e-4).double().mean()) > 0.9


@pytest.mark.parametrize("batch", [1, 2])
def test_queued_steps_are_the_steps_one_by_one(simt: object, scene: Dataset, batch: int) -> None:
    """On engine "cuda" the row of a photo is found on the device; the measurement lies between two queues."""
    together, single = on_engine(scene, "cuda", batch), on_engine(scene, "cuda", batch)
    assert together.run(10) == single.run(10, together=1)
    exposure = together.trainer.exposure
    assert exposure.learned
    assert exposure.explained == single.trainer.exposure.explained
    same_bits(together, single)
    beside = on_engine(scene, "cpu", batch)
    beside.run(10)
    values, wanted = (each.trainer.exposure.values.detach() for each in (together, beside))
    assert float((values - wanted).abs().median()) < 1e-3


def test_going_back_to_before_the_measurement_forgets_it(views: Dataset, gains: Tensor) -> None:
    """As a run does that undoes an edit; then it is measured again, and learned as if for the first time."""
    trainer = true_shape(shot(views, gains, views.train), Exposure(10))
    for iteration in range(1, 9):
        trainer.advance(iteration, iteration)
    before = {name: tensor.clone() for name, tensor in trainer.state().items()}

    def on() -> dict[str, Tensor]:
        for iteration in range(9, 16):
            trainer.advance(iteration, iteration)
            trainer.refine(iteration)
        assert trainer.exposure.learned
        return {name: tensor.clone() for name, tensor in trainer.state().items()}

    expected = on()
    trainer.load_state(before, 8)
    assert not trainer.exposure.learned
    again = on()
    assert [name for name, tensor in expected.items() if not torch.equal(tensor, again[name])] == []


@pytest.mark.parametrize(("iterations", "epoch", "at"), [(1000, 10, 100), (100, 10, 50), (3, 0.1, 1)])
def test_photos_are_measured_when_each_was_seen(iterations: int, epoch: float, at: int) -> None:
    """A tenth of the run, or five epochs."""
    assert Exposure.of("auto", iterations, epoch).next_measurement(1) == at
    assert Exposure.of("auto", iterations, epoch).next_measurement(at + 1) == NEVER
    assert not Exposure.of("off", iterations, epoch).learned
    assert Exposure.of("on", iterations, epoch).next_measurement(1) == at
    assert Exposure.of("on", 40, 32).next_measurement(1) == 20, "in a run that is too short to tell"
    assert Exposure.of("auto", 40, 32).next_measurement(1) > 40


@pytest.mark.parametrize(
    ("explained", "learned"),
    [([0.3], True), ([0.05], False), ([0.15, 0.12], True), ([0.15, 0.3], True), ([0.15, 0.08], False)],
)
def test_what_is_in_doubt_is_measured_again(
    monkeypatch: pytest.MonkeyPatch, views: Dataset, explained: list[float], learned: bool
) -> None:
    """When photos have been seen ten times, not five; a checkpoint between the two forgets nothing."""
    trainer = true_shape(views, exposure := Exposure.of("auto", 100, 2))
    answers = iter(explained)
    monkeypatch.setattr(
        "etsplat.optim.exposure.explained_error", lambda *_: (next(answers), torch.zeros(len(views.train), 3))
    )
    measured = list[int]()
    for iteration in range(1, 31):
        if exposure.next_measurement(iteration) == iteration:
            measured.append(iteration)
        trainer.refine(iteration)
        if iteration == 15:
            exposure.load_state(exposure.state())
    assert measured == [10, 20][: len(explained)]
    assert exposure.learned is learned
    assert exposure.explained == explained[-1]


@pytest.mark.parametrize(("iterations", "epoch"), [(20, 2), (100, 1)])
def test_the_first_answer_counts(
    monkeypatch: pytest.MonkeyPatch, views: Dataset, iterations: int, epoch: float
) -> None:
    """Where there is no time for another, and where photos have been seen ten times by then."""
    trainer = true_shape(views, exposure := Exposure.of("auto", iterations, epoch))
    assert exposure.again_at <= exposure.measured_at == 10
    monkeypatch.setattr("etsplat.optim.exposure.explained_error", lambda *_: (0.15, torch.zeros(len(views.train), 3)))
    trainer.refine(10)
    assert exposure.learned


def along_the_path(views: Dataset) -> Tensor:
    """(P, 3) logarithms of gains that follow where the training cameras are, as along a film."""
    around = torch.atan2(*views.centers[views.train][:, [0, 2]].T).float()
    gains = 0.2 * around.cos()[:, None].expand(-1, 3)
    return gains - gains.mean(dim=0)


def as_views(views: Dataset) -> list[View]:
    return [View(views.cameras[index], torch.zeros(1), None, torch.tensor([index])) for index in views.train]


def test_exposures_that_follow_the_cameras_are_told_from_those_of_their_own(views: Dataset, gains: Tensor) -> None:
    smooth, own = along_the_path(views), gains[views.train].log()
    assert share_of_their_own(smooth, as_views(views)) < 0.25
    assert share_of_their_own(own, as_views(views)) == 1.0
    assert 0.2 < share_of_their_own(2 * smooth + own, as_views(views)) < 0.8
    assert share_of_their_own(smooth[:2], as_views(views)[:2]) == 1.0, "too few to tell"
    assert share_of_their_own(0 * smooth, as_views(views)) == 1.0


@pytest.mark.parametrize(
    ("by_direction", "follows", "learned"), [(True, True, False), (True, False, True), (False, True, True)]
)
def test_what_colours_by_direction_explain_is_not_learned_as_exposures(
    monkeypatch: pytest.MonkeyPatch, views: Dataset, gains: Tensor, by_direction: bool, follows: bool, learned: bool
) -> None:
    """A model of one colour for all directions learns it."""
    exposure = Exposure.of("auto", 100, 1, by_direction=by_direction)
    exposure.start(views.train, 1, torch.zeros(()))
    found = along_the_path(views) if follows else gains[views.train].log()
    monkeypatch.setattr("etsplat.optim.exposure.explained_error", lambda *_: (0.3, found))
    measure: Callable[..., None] = exposure.measure
    measure(None, as_views(views), torch.zeros(1, 3))
    assert exposure.learned is learned
    assert exposure.explained is not None
    assert (exposure.explained == 0.3) is learned


def test_a_step_that_does_not_count_changes_nothing(simt: object, scene: Dataset) -> None:
    """Neither the numbers nor their means."""
    trainer = on_engine(scene, "cuda", choice="on")
    trainer.run(3)
    exposure = trainer.trainer.exposure
    before = {name: tensor.clone() for name, tensor in exposure.state().items()}
    exposure.values.grad = torch.ones_like(exposure.values)
    with etsplat.engine("cuda"):
        exposure.step_on_device(torch.tensor([0.1, 1.0]), torch.tensor(1, dtype=torch.int32))
    assert [name for name, tensor in exposure.state().items() if not torch.equal(tensor, before[name])] == []


def test_photos_without_error_need_nothing(views: Dataset) -> None:
    """A model that is its photos has no error to explain."""
    exposure = Exposure(1)
    exposure.start([0], 1, torch.zeros(()))

    class Copy:
        def render(self, camera: object, **_: object) -> Rasterization:
            return Rasterization(torch.zeros(1, 8, 8, 3), torch.ones(1, 8, 8, 1))

    photos: list[View] = [View(views.cameras[0], torch.zeros(1, 8, 8, 3), None, torch.tensor([0]))]
    measure: Callable[..., None] = exposure.measure
    measure(Copy(), photos, torch.zeros(1, 3))
    assert exposure.explained == 0.0
    assert not exposure.learned


def test_matrices_stay_near_identity(views: Dataset, gains: Tensor) -> None:
    """Of photos in light that differs from place to place, which no matrix explains, the model keeps the colours."""
    pixels = []
    for index, image in enumerate(views.images):
        photo = as_float(image).clone()
        across = torch.linspace(-1, 1, photo.shape[1])[None, :, None]
        tint = torch.randn(3, generator=torch.Generator().manual_seed(index))
        photo[..., :3] *= gains[index].mean() * (0.4 * across * tint).exp()
        pixels.append(photo.clamp_max(1))
    lit = replace(views, images=StoredPictures(pixels))
    exposure = Exposure.of("on", 600, 12)
    true_shape(lit, exposure).fit(600)
    offsets = exposure.values[:, 1:].detach()
    assert float(offsets.abs().max()) < 0.1
