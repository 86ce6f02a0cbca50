"""Photos kept aside watch a run: never fitted to, they choose the result; test photos choose nothing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import count_self_intersections
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.guard import Guard
from etsplat.optim.loop import CheckpointEvent, StepEvent
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import Schedule
from etsplat.optim.strategies import SubdivideAndUntangle
from etsplat.optim.terms.mesh import EdgeLength, Laplacian
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import Trainer
from etsplat.optim.watch import MARGIN

LENGTH = 40


@pytest.fixture(scope="module")
def views() -> Dataset:
    return photograph(demo_object(), 24, 24, elevations=(-35.0, 0.0, 35.0), azimuths=10, supersampling=1)


@pytest.fixture(scope="module")
def watched(views: Dataset) -> Dataset:
    return views.watching()


def trainer(views: Dataset, *, worse_from: int = LENGTH + 1, **schedule: Any) -> Trainer[Any]:
    """Learns until an iteration; from there on vertices move far too fast, and the mesh goes to pieces."""
    vertices, faces = icosphere(2)
    mesh = TriangleMesh.from_mesh(1.05 * vertices, faces, colors=0.5, opacity=0.9, sigma=0.5)
    objective = Objective(Photometric(), [EdgeLength(0.5), Laplacian(0.2)], scale=0.5)
    rates = {**mesh.RATES, "vertices": lambda iteration: 1e-2 if iteration < worse_from else 1.0}
    strategy = SubdivideAndUntangle({10: 400}, [LENGTH])
    return Trainer(mesh, views, objective, strategy, schedule=Schedule(rates, **schedule))


def measured(run: Trainer[Any], **options: Any) -> dict[int, float]:
    """The PSNR of the watched photos by iteration."""
    events: list[Any] = []
    run.fit(LENGTH, callbacks=[events.append], evaluate_every=5, **options)
    steps = [event for event in events if isinstance(event, StepEvent) and event.metrics]
    return {event.iteration: event.metrics["watched_psnr"] for event in steps}


@pytest.mark.parametrize(
    ("count", "one_in", "kept"),
    [(23, None, []), (24, None, [12]), (32, None, [8, 24]), (48, 0, []), (10, 5, [2, 7]), (3, 2, [1])],
)
def test_photos_are_kept_aside_evenly(views: Dataset, count: int, one_in: int | None, kept: list[int]) -> None:
    """One in sixteen from 24 on, or what is asked for; train and test keep the others."""
    many = photographed(views, count)
    split = many.watching(one_in)
    assert split.watched == kept
    assert sorted([*split.train, *split.watched]) == many.train
    assert split.test == many.test
    assert split.halved().watched == kept
    assert (split.fingerprint() == many.fingerprint()) == (not kept)
    assert split.watching(3) is split or not kept


def photographed(views: Dataset, train: int) -> Dataset:
    """So many training views, and two for the test; their pictures do not matter."""
    index = [number % len(views) for number in range(train + 2)]
    images = type(views.images)([views.images[0]] * len(index))  # type: ignore[call-arg]
    names = [f"{number:03d}" for number in range(train + 2)]
    rest = {"train": list(range(train)), "test": [train, train + 1]}
    return replace(views, viewmats=views.viewmats[index], Ks=views.Ks[index], images=images, names=names, **rest)


@pytest.mark.parametrize(("one_in", "said"), [(25, "none"), (1, "all")])
def test_keeping_none_or_all_is_refused(views: Dataset, one_in: int, said: str) -> None:
    with pytest.raises(InputError, match=f"watch: one in {one_in} of 24 training photos would be {said};"):
        photographed(views, 24).watching(one_in)


def test_watched_views_are_disjoint_from_the_others(views: Dataset) -> None:
    with pytest.raises(ValueError, match="train, test, watched: expected disjoint"):
        replace(views, watched=views.train[:1])


def test_a_run_fits_to_the_other_photos_alone(watched: Dataset) -> None:
    """Whatever the watched photos and the test photos show, the model has the same bits."""
    scrambled = [
        torch.rand_like(image) if index in {*watched.watched, *watched.test} else image
        for index, image in enumerate(watched.images)
    ]
    other = replace(watched, images=type(watched.images)(scrambled))  # type: ignore[call-arg]
    first, second = trainer(watched), trainer(other)
    assert measured(first) != measured(second)
    for name, tensor in first.model.state().items():
        assert torch.equal(tensor, second.model.state()[name])


def test_watching_changes_no_step(watched: Dataset) -> None:
    """The same training views without it: the same bits, and nothing in the history or the checkpoint."""
    first, second = trainer(watched), trainer(replace(watched, watched=[]))
    first.fit(LENGTH, evaluate_every=3)
    second.fit(LENGTH, evaluate_every=3)
    assert {name for name in first.state() if not name.startswith("watch.")} == second.state().keys()
    assert [name for name, tensor in second.state().items() if not torch.equal(tensor, first.state()[name])] == []
    assert second.outcome().metrics == {}


def test_a_run_that_gets_better_gives_its_last_state(watched: Dataset) -> None:
    run = trainer(watched)
    psnr = measured(run)
    assert psnr[LENGTH] > psnr[5]
    outcome = run.outcome()
    assert outcome.model is run.model
    assert outcome.note is None
    assert outcome.metrics == {
        "watched_views": 1,
        "watched_psnr": psnr[LENGTH],
        "watched_psnr_last": psnr[LENGTH],
        "result_iteration": LENGTH,
    }


def test_a_run_that_got_worse_gives_its_best_state_and_says_so(watched: Dataset) -> None:
    """With the untangling that the last state had; the run itself is where it was, and can be gone on with."""
    run = trainer(watched, worse_from=31)
    psnr = measured(run)
    best = max(psnr, key=lambda iteration: psnr[iteration])
    assert best in (25, 30)
    assert psnr[best] > psnr[LENGTH] + MARGIN
    before = {name: tensor.clone() for name, tensor in run.state().items()}
    outcome = run.outcome()
    assert outcome.iteration == best
    assert outcome.note is not None
    assert f"the result is of iteration {best}" in outcome.note
    assert outcome.psnr == pytest.approx(psnr[best], abs=0.1)
    assert outcome.last_psnr == psnr[LENGTH]
    assert outcome.model is not run.model
    assert count_self_intersections(outcome.model.vertices.detach(), outcome.model.faces) == 0
    assert [name for name, tensor in run.state().items() if not torch.equal(tensor, before[name])] == []


def test_within_the_margin_the_last_state_is_the_result(watched: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("etsplat.optim.watch.MARGIN", 100.0)
    run = trainer(watched, worse_from=31)
    measured(run)
    assert run.outcome().model is run.model


def test_what_is_drawn_otherwise_does_not_compete(watched: Dataset) -> None:
    """A softness that a schedule sets, or photos that are halved: then later states alone count."""
    soft = trainer(watched, worse_from=31, values={"log_sigma": lambda iteration: -0.7 - 0.001 * iteration})
    measured(soft)
    assert soft.outcome().iteration == LENGTH
    coarse = trainer(watched, worse_from=31, halvings=lambda iteration: int(iteration < 34))
    measured(coarse)
    assert coarse.outcome().iteration >= 35


def test_an_untangling_that_was_undone_is_not_made_on_the_best_state(watched: Dataset) -> None:
    run = trainer(watched, worse_from=31)
    measured(run)
    run.guard = Guard()
    run.guard.undone = [LENGTH]
    run.strategy.finish = lambda model: pytest.fail("untangled")  # type: ignore[method-assign]
    assert run.outcome().iteration < LENGTH


def test_the_best_state_and_its_score_survive_a_kill(watched: Dataset, tmp_path: Path) -> None:
    """Killed after the best, resumed, and resumed again when it is done: the same outcome to the bit."""
    whole = trainer(watched, worse_from=31)
    measured(whole)
    expected = whole.outcome()

    def kill(event: object) -> None:
        if isinstance(event, CheckpointEvent) and event.iteration == 36:
            raise RuntimeError("killed")

    run = RunDirectory.create(tmp_path / "run", {"task": "train"})
    with pytest.raises(RuntimeError, match="killed"):
        trainer(watched, worse_from=31).fit(LENGTH, callbacks=[kill], evaluate_every=5, checkpoint_every=12, run=run)
    for _ in range(2):
        resumed = trainer(watched, worse_from=31)
        resumed.fit(LENGTH, evaluate_every=5, checkpoint_every=12, run=run)
        outcome = resumed.outcome()
        assert outcome.metrics == expected.metrics
        for name, tensor in expected.model.state().items():
            assert torch.equal(tensor, outcome.model.state()[name])


def test_the_step_line_says_how_they_are(watched: Dataset) -> None:
    event = StepEvent(5, 10, 1.0, 0.1, {"faces": 20}, {"psnr": 30.0, "watched_psnr": 29.5})
    assert event.summary == "loss 0.1000 · 30.00 dB · watched 29.50 dB · 20 faces"
