"""Edits that spoil what training has reached are undone, to the bit, and the others stay."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from etsplat.data.dataset import Dataset, middles_of
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.geometry.icosphere import icosphere
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.checkpoints import list_checkpoints
from etsplat.optim.gauge import Gauge
from etsplat.optim.guard import Guard
from etsplat.optim.loop import CheckpointEvent, Progress, RefineEvent, UndoEvent
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import Schedule
from etsplat.optim.strategies import SubdivideAndUntangle
from etsplat.optim.terms.mesh import EdgeLength, Laplacian
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import Trainer
from helpers.reconstructions import KilledError

LENGTH = 60


@pytest.fixture(scope="module")
def views() -> Dataset:
    return photograph(demo_object(), 24, 24, elevations=(-35.0, 35.0), azimuths=5, supersampling=1)


class Spoil(SubdivideAndUntangle):
    """Subdivides at 10 and 40, and blows the mesh up at given times."""

    def __init__(self, *spoiled: int) -> None:
        super().__init__({10: 400, 40: 500}, spoiled)
        self._spoiled = spoiled

    def edit(self, iteration: int) -> bool:
        if iteration in self._spoiled:
            with torch.no_grad():
                self.model.vertices.mul_(1.4)
            return False
        return super().edit(iteration)


def trainer(
    views: Dataset, *spoiled: int, kind: type[Spoil] = Spoil, guarded: bool = True, steps: int = 8, **options: Any
) -> Trainer[Any]:
    vertices, faces = icosphere(2)
    mesh = TriangleMesh.from_mesh(1.05 * vertices, faces, colors=0.5, opacity=0.9, sigma=0.5)
    objective = Objective(Photometric(), [EdgeLength(0.5), Laplacian(0.2)], scale=0.5)
    guard = Guard(steps=steps, until=LENGTH) if guarded else None
    schedule = Schedule({**mesh.RATES, "vertices": 1e-2})
    return Trainer(mesh, views, objective, kind(*spoiled), schedule=schedule, guard=guard, **options)


def final(run: Trainer[Any]) -> dict[str, torch.Tensor]:
    """All but what the guard remembers."""
    return {name: tensor for name, tensor in run.state().items() if not name.startswith("guard.")}


def assert_equal(first: Trainer[Any], second: Trainer[Any]) -> None:
    expected, found = final(first), final(second)
    assert found.keys() == expected.keys()
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def logged(folder: Path) -> list[dict[str, Any]]:
    """The history without its clock and what was undone."""
    lines = RunDirectory(folder).read_history()
    return [{key: value for key, value in line.items() if key not in ("seconds", "undone")} for line in lines]


def killed_and_resumed(
    views: Dataset, run: RunDirectory, dies: Callable[[bool, int], bool], **options: Any
) -> Trainer[Any]:
    """A run that spoils the mesh at 20, killed at a checkpoint and gone on with.

    `dies` is asked whether something was undone, and for the iteration.
    """
    killed, resumed = (trainer(views, 20, **options) for _ in range(2))

    def kill(event: object) -> None:
        assert killed.guard is not None
        if isinstance(event, CheckpointEvent) and dies(bool(killed.guard.undone), event.iteration):
            raise KilledError

    with pytest.raises(KilledError):
        killed.fit(LENGTH, callbacks=[kill], log_every=5, checkpoint_every=3, run=run)
    resumed.fit(LENGTH, log_every=5, checkpoint_every=3, run=run)
    return resumed


def test_a_run_in_which_nothing_is_undone_keeps_its_bits(views: Dataset) -> None:
    """Measuring draws no random number; and the checkpoint at the end has no trace of it."""
    guarded, plain = trainer(views), trainer(views, guarded=False)
    guarded.fit(LENGTH)
    plain.fit(LENGTH)
    assert guarded.state().keys() == plain.state().keys()
    assert_equal(plain, guarded)


@pytest.mark.parametrize("steps", [8, 100])
def test_what_spoils_is_undone_as_if_it_had_never_been(views: Dataset, tmp_path: Path, steps: int) -> None:
    """Judged after 8 steps or before the next edit, and at once after the last step; the subdivisions stay."""
    events: list[Any] = []
    run, plain = trainer(views, 20, LENGTH, steps=steps), trainer(views, guarded=False)
    places = {"log_every": 5, "checkpoint_every": 7, "run_hash": ""}
    run.fit(LENGTH, callbacks=[events.append], run=tmp_path / "run", **places)
    plain.fit(LENGTH, run=tmp_path / "plain", **places)
    undone = [event for event in events if isinstance(event, UndoEvent)]
    assert [(event.iteration, event.judged) for event in undone] == [(20, min(20 + steps, 40)), (LENGTH, LENGTH)]
    assert all(event.loss_after > 1.02 * event.loss_before for event in undone)
    assert "20: the edit of the triangles is undone" in str(undone[0])
    assert str(undone[0]).endswith("than before; the run goes on without")
    assert [event.iteration for event in events if isinstance(event, RefineEvent)] == [10, 40]
    assert_equal(plain, run)
    assert run.guard is not None
    assert run.guard.undone == [20, LENGTH]
    assert run.progress.iteration == LENGTH
    assert logged(tmp_path / "run") == logged(tmp_path / "plain")
    (first, last) = (line for line in RunDirectory(tmp_path / "run").read_history() if "undone" in line)
    assert (first["iteration"], last["iteration"]) == (20, LENGTH)
    assert first["undone"]["judged"] == undone[0].judged
    assert first["undone"]["loss_after"] == undone[0].loss_after


class Milder(Spoil):
    """Has a second way of making the edits that spoil: one that hardly moves the mesh."""

    def attempts(self, iteration: int) -> int:
        return 2

    def edit(self, iteration: int) -> bool:
        if iteration in self._spoiled and self.undone == 1:
            with torch.no_grad():
                self.model.vertices.mul_(1.0001)
            return False
        return super().edit(iteration)


def test_what_spoils_is_tried_again_milder_and_resumes_there(views: Dataset, tmp_path: Path) -> None:
    """The second attempt stays: as if the run had never had another; also if it is killed in that one's trial."""

    class Mild(Milder):
        undone = 1

    events: list[Any] = []
    whole, mild = trainer(views, 20, kind=Milder), trainer(views, 20, kind=Mild, guarded=False)
    whole.fit(LENGTH, callbacks=[events.append], log_every=5)
    mild.fit(LENGTH, log_every=5)
    assert whole.guard is not None
    assert whole.guard.undone == [20]
    assert [str(event).split("; ")[-1] for event in events if isinstance(event, UndoEvent)] == ["a milder one is tried"]
    assert_equal(mild, whole)

    run = RunDirectory.create(tmp_path / "run", {"task": "train"})
    assert_equal(
        whole, killed_and_resumed(views, run, lambda undone, iteration: undone and iteration == 24, kind=Milder)
    )


def test_an_undone_edit_between_logs_has_a_line_of_its_own(views: Dataset, tmp_path: Path) -> None:
    run = trainer(views, 22)
    run.fit(LENGTH, log_every=10, run=tmp_path, run_hash="")
    lines = RunDirectory(tmp_path).read_history()
    assert [line["iteration"] for line in lines] == [10, 20, 22, 30, 40, 50, 60]
    assert lines[2].keys() == {"iteration", "undone"}


@pytest.mark.parametrize("killed_at", [12, 21, 24, 27, 29, 42])
def test_a_run_killed_around_a_trial_ends_with_the_same_bits(views: Dataset, tmp_path: Path, killed_at: int) -> None:
    """Killed at a checkpoint (every third iteration): before the trial, in it, after the way back."""
    whole, run = trainer(views, 20), RunDirectory.create(tmp_path / "run", {"task": "train"})
    whole.fit(LENGTH, log_every=5)
    resumed = killed_and_resumed(views, run, lambda undone, iteration: iteration >= killed_at)
    assert_equal(whole, resumed)
    assert resumed.guard is not None
    assert resumed.guard.undone == [20]
    assert [line["iteration"] for line in run.read_history() if "undone" in line] == [20]


def test_going_back_leaves_no_checkpoint_of_what_is_undone(views: Dataset, tmp_path: Path) -> None:
    """At any moment the newest one is of a run that may still be; after the way back it is the edit's iteration."""
    run, found = RunDirectory.create(tmp_path / "run", {"task": "train"}), dict[int, list[str]]()

    def look(event: object) -> None:
        if isinstance(event, CheckpointEvent):
            found[event.iteration] = [path.stem for path in list_checkpoints(run.checkpoints)]

    trainer(views, 20).fit(LENGTH, callbacks=[look], checkpoint_every=3, run=run)
    assert found[20][-1] == "step_000020"
    assert len(found[20]) <= 2


def test_an_edit_that_changes_nothing_is_not_judged(views: Dataset) -> None:
    """Where no face cuts through another, untangling leaves everything as it is."""
    run = trainer(views)
    run.strategy = SubdivideAndUntangle({}, [5])
    run.strategy.start(run.model, run.adam, 8, torch.Generator())
    run.fit(5)
    assert run.guard is not None
    assert run.guard.held is None


def test_lids_that_are_undone_come_back_and_the_untangling_without_them_is_made(views: Dataset) -> None:
    """With the bits of a run that looked for none; a guard that nothing pleases undoes subdivisions too."""

    def upper(vertices: torch.Tensor, faces: torch.Tensor, colors: torch.Tensor) -> torch.Tensor:
        assert colors.shape == faces.shape
        return vertices[faces][..., 1].amin(dim=1) > 0.2

    runs = []
    for lids in (upper, None):
        run = trainer(views)
        run.guard = Guard(tolerance=-0.99, steps=8, until=LENGTH)
        run.strategy = SubdivideAndUntangle({10: 400, 40: 500}, [20, 50], lids=lids)
        run.strategy.start(run.model, run.adam, 8, torch.Generator())
        run.fit(LENGTH)
        runs.append(run)
    assert [run.guard.undone for run in runs if run.guard] == [[10, 10, 20, 40, 40], [10, 40]]
    assert_equal(*runs)


def test_pictures_are_drawn_once_of_each_state(views: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    measure = Gauge.measure

    def counted(gauge: Gauge, model: TriangleMesh, *others: Any) -> Any:
        seen.append(hash(tuple(tensor.numpy().tobytes() for tensor in model.state().values())))
        return measure(gauge, model, *others)

    monkeypatch.setattr(Gauge, "measure", counted)
    run = trainer(views, 30, 35, steps=100)  # each edit is judged where the next is made
    run.fit(LENGTH)
    assert run.guard is not None
    assert run.guard.undone == [30, 35]
    assert len(seen) == len(set(seen)) == 7  # at 10, 30, 35, where 30 is undone, 35, 40, where 35 is, 40 and 60


def test_a_guard_that_tolerates_more_lets_it_stay(views: Dataset) -> None:
    run = trainer(views, 20)
    run.guard = Guard(tolerance=1e9, steps=8)
    events: list[Any] = []
    run.fit(LENGTH, callbacks=[events.append])
    assert not [event for event in events if isinstance(event, UndoEvent)]


def test_a_loss_that_is_not_a_number_is_undone() -> None:
    guard = Guard()
    guard.hold(Progress(iteration=5), 1000, 0.1, {"a": torch.zeros(2)})
    assert guard.due == 105
    held = guard.judge(float("nan"))
    assert held is not None
    assert held.iteration == 5


@pytest.mark.parametrize(("views_of", "count", "expected"), [(8, 8, list(range(8))), (8, 2, [2, 6]), (9, 1, [4])])
def test_views_are_spread_evenly(views_of: int, count: int, expected: list[int]) -> None:
    assert middles_of(range(views_of), count) == expected


def test_a_gauge_measures_at_its_own_size(views: Dataset) -> None:
    """Whatever the size of the photos."""
    run = trainer(views)
    sizes = []
    for side in (24, 20, 6):
        gauge = Gauge(views, views.train, side, torch.device("cpu"))
        sizes.append({view.photo.shape[1] for view in gauge._views})
        assert 0 < gauge.measure(run.model, run._objective, run.exposure).loss < 1
    assert sizes == [{24}, {12}, {6}]
