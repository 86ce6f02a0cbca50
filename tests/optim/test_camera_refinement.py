"""Poses that are poor on purpose are repaired, on every engine, and only where photos that are kept aside agree."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.photograph import photograph
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.io.run_directory import RunDirectory
from etsplat.io.tensors import read_tensors, save_tensors
from etsplat.model.soup_init import StartPoints, start_soup
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.camera_event import CamerasEvent
from etsplat.optim.camera_motion import common_motions, moved, unit_motions
from etsplat.optim.camera_refinement import CameraRefinement
from etsplat.optim.guard import Guard
from etsplat.optim.loop import Event, StepEvent
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import Schedule
from etsplat.optim.strategies import DensifyAndPrune
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import Trainer
from helpers.engines import device_of
from helpers.trainers import OnEngine, same_bits

STEPS, BRIEF = 200, 60


def ball() -> MeshFile:
    vertices, faces = icosphere(2)
    colors = torch.rand(len(faces), 3, generator=torch.Generator().manual_seed(8))
    return MeshFile(vertices * torch.tensor([1.0, 0.8, 0.6]), faces, face_colors=colors)


@pytest.fixture(scope="module")
def right() -> Dataset:
    """Photos of an ellipsoid of many colours, some kept aside."""
    return photograph(ball(), 40, 40, elevations=(-20.0, 20.0), azimuths=8, supersampling=2).watching(4)


def turned(dataset: Dataset, points: Tensor, degrees: float = 1.0, part: float = 0.02) -> Dataset:
    """Every camera turned about a random axis and shifted by a part of its distance.

    Less what moves those of training photos alike: it cannot be told from a model that is moved the other way.
    """
    rng = torch.Generator().manual_seed(3)
    motions = []
    for camera in dataset.cameras:
        turn, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=rng, dtype=torch.float64), dim=1)
        motions.append(torch.cat([math.radians(degrees) * turn, part * float(camera.centers.norm()) * shift]))
    units = torch.stack([unit_motions(points, camera) for camera in dataset.cameras])
    common = common_motions(dataset.viewmats[dataset.train], units[dataset.train])
    learned = torch.linalg.solve(units, torch.stack(motions)[..., None])[..., 0]
    trained = learned[dataset.train].flatten()
    learned[dataset.train] = (trained - common @ (common.T @ trained)).view(-1, 6)
    viewmats = dataset.viewmats.clone()
    for view, camera in enumerate(dataset.cameras):
        exact = Cameras(viewmats[view][None], dataset.Ks[view][None], camera.width, camera.height)
        viewmats[view] = moved(exact, units[view] @ learned[view]).viewmats[0]
    return replace(dataset, viewmats=viewmats)


def off_by(found: Dataset, right: Dataset, views: list[int]) -> float:
    """How far what is in the middle of the photos is from where it should be in them, in pixels; mean over views."""
    points = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]], dtype=torch.float64)

    def pixels(dataset: Dataset) -> Tensor:
        seen = points @ dataset.viewmats[views, :3, :3].mT + dataset.viewmats[views, None, :3, 3]
        seen = seen @ dataset.Ks[views].mT
        return seen[..., :2] / seen[..., 2:]

    return float((pixels(found) - pixels(right)).norm(dim=-1).mean())


def true_shape(dataset: Dataset, cameras: CameraRefinement | None, **options: Any) -> Trainer[TriangleMesh]:
    """The true shape, whose colours are learned: with poor poses they mix."""
    shape = ball()
    vertices = dataset.normalization.apply(shape.vertices).float()
    mesh = TriangleMesh.from_mesh(vertices, shape.faces, colors=0.5, opacity=0.98, sigma=0.1)
    rates = Schedule({"vertices": 0.0, "colors": 3e-2, "opacity_logits": 0.0, "log_sigma": 0.0})
    return Trainer(mesh, dataset, Objective(Photometric()), schedule=rates, cameras=cameras, **options)


def refinement(lenses: bool = False) -> CameraRefinement:
    """In the middle of a run of `STEPS`."""
    return CameraRefinement(20, 100, 180, rate=lambda iteration: 0.008 * 0.97 ** (iteration - 20), lenses=lenses)


def briefly() -> CameraRefinement:
    """Where only the bits count."""
    return CameraRefinement(10, 35, 55, rate=0.006)


def events_of(trainer: Trainer[Any], iterations: int = STEPS, **options: Any) -> list[Event]:
    events: list[Event] = []
    trainer.fit(iterations, callbacks=[events.append], log_every=1, **options)
    return events


def differing(trainer: Trainer[Any], expected: dict[str, Tensor]) -> list[str]:
    state = trainer.state()
    assert state.keys() == expected.keys()
    return [name for name in expected if not torch.equal(state[name], expected[name])]


def test_poor_poses_are_repaired(right: Dataset) -> None:
    """Training photos, and those kept aside, which the model does not see; test photos stay where they were given."""
    given = turned(right, ball().vertices)
    trainer = true_shape(given, refinement())
    decided = [event for event in events_of(trainer) if isinstance(event, CamerasEvent)]
    assert [(event.iteration, event.stays) for event in decided] == [(20, None), (100, True)]
    assert decided[1].refined is not None
    assert decided[1].refined > decided[1].given
    refined = trainer.cameras.refined(given)
    for views in (right.train, right.watched):
        assert off_by(refined, right, views) < 0.35 * off_by(given, right, views)
    assert torch.equal(refined.viewmats[right.test], given.viewmats[right.test])
    assert torch.equal(refined.Ks, given.Ks)


def test_focal_lengths_that_are_wrong_are_found_too(right: Dataset) -> None:
    """One factor for all photos of a camera."""
    Ks = right.Ks.clone()
    Ks[:, :2, :2] *= 1.05
    given = replace(right, Ks=Ks)
    trainer = true_shape(given, CameraRefinement(1, STEPS, STEPS, rate=0.004, lenses=True))
    colors = ball().face_colors
    assert colors is not None
    with torch.no_grad():
        known = TriangleMesh.from_mesh(trainer.model.vertices, ball().faces, colors=colors, opacity=0.98, sigma=0.1)
        trainer.model.colors.copy_(known.colors)
    trainer.cameras.activate(trainer.model.vertices.detach())
    for iteration in range(1, 81):
        trainer.advance(iteration, iteration)
    factor = trainer.cameras.refined(given).Ks[right.train, 0, 0] / right.Ks[right.train, 0, 0]
    assert float((factor - 1).abs().max()) < 0.015
    assert float(factor.max() - factor.min()) < 1e-6


def test_what_moves_all_cameras_alike_is_taken_out(right: Dataset) -> None:
    """After every step the learned motions have none of it."""
    trainer = true_shape(turned(right, ball().vertices), refinement())
    trainer.cameras.activate(trainer.model.vertices.detach())
    for iteration in range(1, 21):
        trainer.advance(iteration, iteration)
    learned = trainer.cameras.poses.detach()[: len(right.train)].flatten()
    assert float(learned.norm()) > 0.02
    assert float((trainer.cameras._common.T @ learned).norm()) < 1e-5


def test_cameras_are_kept_to_the_bit_where_refining_does_no_good(right: Dataset) -> None:
    """At a rate that shakes them. The run goes on as if it had never refined them."""
    tried, plain = true_shape(right, CameraRefinement(20, 100, 180, rate=0.3)), true_shape(right, None)
    events = events_of(tried)
    decided = [event for event in events if isinstance(event, CamerasEvent)]
    assert [(event.iteration, event.stays) for event in decided] == [(20, None), (100, False)]
    expected = [event for event in events_of(plain) if isinstance(event, StepEvent)]
    last = [event for event in events if isinstance(event, StepEvent)][-100:]
    assert [event.loss for event in last] == [event.loss for event in expected[-100:]]
    state = {name: tensor for name, tensor in tried.state().items() if not name.startswith("trial.")}
    assert state.keys() == plain.state().keys()
    assert [name for name, tensor in plain.state().items() if not torch.equal(state[name], tensor)] == []
    assert tried.cameras.refined(right) is right


@pytest.fixture(scope="module")
def whole(right: Dataset) -> Trainer[TriangleMesh]:
    """A run that was never killed."""
    trainer = true_shape(turned(right, ball().vertices), briefly(), guard=Guard(until=BRIEF))
    trainer.fit(BRIEF, evaluate_every=20)
    return trainer


@pytest.mark.parametrize("killed_at", [20, 30, 50])
def test_a_resumed_run_ends_with_the_same_bits(
    right: Dataset, whole: Trainer[TriangleMesh], tmp_path: Path, killed_at: int
) -> None:
    """Killed with cameras as given, with refined ones before these are judged, and after it."""
    given, seen = turned(right, ball().vertices), 0

    def kill(event: object) -> None:
        nonlocal seen
        if isinstance(event, StepEvent) and event.iteration == killed_at:
            seen += 1
            if seen == (2 if killed_at == 30 else 1):
                raise RuntimeError("killed")

    run = RunDirectory.create(tmp_path / "run", {"task": "fit"})
    first, resumed = (true_shape(given, briefly(), guard=Guard(until=BRIEF)) for _ in range(2))
    options = {"log_every": 1, "evaluate_every": 20, "checkpoint_every": 8, "run": run}
    with pytest.raises(RuntimeError, match="killed"):
        first.fit(BRIEF, callbacks=[kill], **options)
    resumed.fit(BRIEF, **options)
    assert differing(resumed, whole.state()) == []
    assert resumed.trial.metrics == whole.trial.metrics
    forgotten = range(0) if resumed.cameras.active else range(11, 35)
    logged = [number for number in range(1, BRIEF + 1) if number not in forgotten]
    assert [line["iteration"] for line in run.read_history()] == logged


def test_a_checkpoint_of_a_version_before_is_refused(right: Dataset, tmp_path: Path) -> None:
    """Versions before moved cameras by Adam, whose checkpoints have no clock of each camera."""
    wrong = turned(right, ball().vertices, 2.0, 0.04)  # so much that refined ones are kept on any machine
    first, resumed = (true_shape(wrong, briefly()) for _ in range(2))
    first.fit(BRIEF, run=tmp_path)
    path = tmp_path / "checkpoints" / "step_000060.safetensors"
    tensors, metadata = read_tensors(path)
    del tensors["cameras.squares"]
    save_tensors(path, tensors, metadata)
    with pytest.raises(InputError, match=r"step_000060\.safetensors: another .* lacks `squares`; .*again in another"):
        resumed.fit(BRIEF + 10, run=tmp_path)


def test_photos_must_be_kept_aside(right: Dataset) -> None:
    """Or nobody could judge."""
    with pytest.raises(ValueError, match="kept aside"):
        true_shape(replace(right, watched=[]), refinement())


def on_engine(scene: Dataset, engine: str, batch: int = 1) -> OnEngine:
    """Cameras move from the first step; triangles come after iteration 4."""
    assert scene.points is not None
    points = scene.points[::150]
    start = StartPoints(points, torch.full_like(points, 0.5))
    rng = torch.Generator().manual_seed(3)
    soup = start_soup(start, rng, scale=2.0, opacity=0.4, sigma=1.0, sh_degree=1).to(torch.device(device_of(engine)))

    def make() -> Trainer[Any]:
        strategy = DensifyAndPrune(begin=3, every=4, max_triangles=300)
        cameras = CameraRefinement(1, 1 << 40, 6, lenses=True)
        trainer = Trainer(soup, scene, Objective(Photometric(0.2)), strategy, cameras=cameras, batch=batch)
        trainer.cameras.activate(soup.vertices.detach().reshape(-1, 3))
        return trainer

    return OnEngine(engine, make)


@pytest.fixture(scope="module")
def scene() -> Dataset:
    """Cameras that are right move too: Adam takes a whole step however small a gradient is."""
    return demo_scene(40, 32).watching(8)


def test_cameras_move_alike_on_every_engine(engine: str, scene: Dataset) -> None:
    """After a few steps, beside the reference."""
    ours, reference = (on_engine(scene, name) for name in (engine, "reference"))
    for trainer in (ours, reference):
        trainer.run(3)
    for name in ("poses", "lenses"):
        values, wanted = (each.trainer.cameras.learned[name].detach().cpu() for each in (ours, reference))
        assert float(wanted.abs().max()) > 1e-4
        assert float((values - wanted).abs().median()) < 1e-5


@pytest.mark.parametrize("batch", [1, 2])
def test_queued_steps_are_the_steps_one_by_one(simt: object, scene: Dataset, batch: int) -> None:
    """On engine "cuda"; cameras rest after iteration 6."""
    together, single = on_engine(scene, "cuda", batch), on_engine(scene, "cuda", batch)
    assert together.run(8) == single.run(8, together=1)
    same_bits(together, single)
    assert float(together.trainer.cameras.poses.detach().abs().max()) > 1e-4


def test_a_step_that_does_not_count_moves_no_camera(simt: object, scene: Dataset) -> None:
    """Neither by its gradients nor by the gauge."""
    trainer = on_engine(scene, "cuda")
    trainer.run(3)
    cameras = trainer.trainer.cameras
    before = {name: tensor.clone() for name, tensor in cameras.state().items()}
    for parameter in cameras.learned.values():
        parameter.grad = torch.ones_like(parameter)
    with etsplat.engine("cuda"):
        cameras.step_on_device(torch.tensor([0.1, 0.1, 1.0]), torch.tensor(1, dtype=torch.int32))
    assert [name for name, tensor in cameras.state().items() if not torch.equal(tensor, before[name])] == []
