"""Several workers make one run with the bits of one process."""

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.workers import Traffic
from etsplat.core.errors import InputError
from etsplat.optim import shared_steps, stepper
from etsplat.optim.loop import DivergedError
from etsplat.optim.shared_steps import owners, pack, unpack
from helpers import shared_runs
from helpers.crew import Crew, crew_of
from helpers.shared_runs import digest_of_checkpoint, same


@pytest.fixture(scope="module")
def crew(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Crew]:
    with crew_of(4, tmp_path_factory.mktemp("crew")) as crew:
        yield crew


@pytest.mark.parametrize(("batch", "counts"), [(1, (2,)), (4, (1, 2, 3, 4)), (5, (2, 3, 4))])
@pytest.mark.parametrize("kind", ["soup", "normals", "inseparable", "mesh"])
def test_any_number_of_workers_gives_the_same_bits(
    crew: Crew, kind: str, batch: int, counts: tuple[int, ...], tmp_path: Path
) -> None:
    """Of the state, the moments and the random numbers; the soup grew and was pruned, the mesh was subdivided."""
    alone = shared_runs.fit_alone(kind, batch)
    assert alone["edits"]
    for count in counts:
        runs = crew.act(count, shared_runs.fit, kind, batch, tmp_path / f"run_{count}")
        assert [(run["state"], run["edits"]) for run in runs] == count * [(alone["state"], alone["edits"])]
        assert digest_of_checkpoint(tmp_path / f"run_{count}") == alone["checkpoint"]
        messages = sum(run["sent"]["messages"] for run in runs)
        assert messages == (0 if count == 1 else shared_runs.ITERATIONS * batch)


def test_messages_travel_while_the_next_view_is_drawn(crew: Crew) -> None:
    """Those of a worker's first view are on their way before its second is begun; their order is that of the views."""
    owners, messages = [1, 0, 0, 1, 0], [(number + 1) * [number] for number in range(5)]
    first, second = crew.act(2, shared_runs.handed_round, owners)
    assert first == (
        ["make 1", "from 1", "from 0", "make 2", "from 0", "from 1", "make 4", "from 0"],
        messages,
    )
    assert second == (["make 0", "from 1", "from 0", "make 3", "from 0", "from 1", "from 0"], messages)
    idle = crew.act(3, shared_runs.handed_round, [2, 0, 2])[1]
    assert idle == (["from 2", "from 0", "from 2"], messages[:3])


@pytest.mark.parametrize("batch", [4, 5])
def test_four_workers_ask_of_the_network_what_the_model_says(crew: Crew, batch: int) -> None:
    """Calls and bytes that reach torch.distributed, against benchmarks/workers.py; the run ends with one more question
    whether somebody was interrupted."""
    steps, count = shared_runs.ITERATIONS, 4
    runs, model = crew.act(count, shared_runs.fit_counted, "soup", batch), Traffic.of(batch, count)
    messages = sum(run["sent"]["bytes"] for run in runs)
    for run in runs:
        assert run["broadcasts"] == steps * model.broadcasts
        assert run["gatherings"] == steps * model.gatherings + 1
        assert run["own"] == run["sent"]["bytes"]
        assert run["received"] == messages - run["own"]
    received = [steps * batch - run["sent"]["messages"] for run in runs]
    assert sum(received) == steps * batch * (count - 1)
    if batch == count:  # nobody draws more than another
        assert received == count * [steps * model.received]


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("kind", ["soup", "normals", "inseparable", "mesh"])
def test_what_travels_adds_up_to_the_gradients_of_one_process(
    kind: str, batch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit, step by step, whatever the objective looks at; what all can compute for themselves is not sent."""
    alone = shared_runs.gradients_of_steps(kind, batch, 4)
    group = shared_runs.TwoInOne()
    monkeypatch.setattr(stepper, "workers", lambda: group)
    for module in (stepper, shared_steps):
        monkeypatch.setattr(module, "owners", lambda views, _: [0] * len(views))
    assert shared_runs.gradients_of_steps(kind, batch, 4) == alone
    sent = [set(unpack(message)) for message in group.messages]
    if kind == "mesh":
        assert not any("colors" in names for names in sent)
        return
    assert all({"colors", "center", "degree"} <= names for names in sent)
    of_parameters = [{"gradient.0.sh_rest", "gradient.0.sh_dc"} & names for names in sent]
    last = {"gradient.0.sh_dc"} if kind == "inseparable" else set[str]()
    assert of_parameters == 4 * [*(batch - 1) * [set()], last]


@pytest.mark.parametrize("kind", ["soup", "mesh"])
def test_another_order_of_the_sum_gives_other_bits(crew: Crew, kind: str) -> None:
    """The control: were sums of no account, the test above could not fail."""
    runs = crew.act(2, shared_runs.fit_swapped, kind, 4)
    assert runs[0]["state"] == runs[1]["state"] != shared_runs.fit_alone(kind, 4)["state"]


@pytest.mark.parametrize("kind", ["soup", "mesh"])
def test_a_run_goes_on_with_any_number_of_workers(crew: Crew, kind: str, tmp_path: Path) -> None:
    """Begun by two, gone on with by four, ended by one."""
    folder = tmp_path / "run"
    for count, until in ((2, 5), (4, 10)):
        crew.act(count, shared_runs.fit, kind, 5, folder, until)
    last, alone = shared_runs.fit(kind, 5, folder), shared_runs.fit_alone(kind, 5)
    assert last["state"] == alone["state"]
    assert digest_of_checkpoint(folder) == alone["checkpoint"]


def test_a_photo_that_is_not_a_number_ends_the_run_on_all(crew: Crew, tmp_path: Path) -> None:
    """At the same step, whoever draws it, with the words of one process."""
    errors = [*crew.act(3, shared_runs.fit, "nan", 4), *crew.act(2, shared_runs.fit, "nan", 4)]
    with pytest.raises(DivergedError) as alone:
        shared_runs.fit("nan", 4)
    assert {type(error) for error in errors} == {DivergedError}
    assert {str(error) for error in errors} == {str(alone.value)}


def test_workers_that_differ_refuse(crew: Crew) -> None:
    """In a setting, in what computes, or in a parameter, at the next log."""
    for name, message in (
        ("seed", "settings: worker 0 has .*, worker 1 has"),
        ("instruction set", "instruction set: worker 0 has .*, worker 1 has another; the bits of a run need the same"),
        ("parameter", "state of the run: worker 0 has .*, worker 1 has .*"),
    ):
        errors = crew.act(2, shared_runs.fit_unlike, name)
        assert same([str(error) for error in errors])
        with pytest.raises(InputError, match=message):
            raise errors[1]


def test_an_interruption_of_one_stops_all_at_one_step(crew: Crew, tmp_path: Path) -> None:
    """With a checkpoint, from which one process ends as if nothing had happened."""
    stopped = crew.act(3, shared_runs.fit_interrupted, "mesh", 4, tmp_path / "run")
    assert len(set(stopped)) == 1
    assert digest_of_checkpoint(tmp_path / "run").startswith(f"step_{stopped[0]:06d}")
    assert shared_runs.fit("mesh", 4, tmp_path / "run")["state"] == shared_runs.fit_alone("mesh", 4)["state"]


def test_what_the_first_makes_all_have_also_its_errors(crew: Crew) -> None:
    assert crew.act(3, shared_runs.made_by_first) == [0, 0, 0]
    errors = crew.act(2, shared_runs.failed_by_first)
    assert [(type(error), str(error)) for error in errors] == 2 * [(InputError, "disk: full")]
    assert crew.act(3, shared_runs.mapped, 7) == 3 * [[0, 1, 4, 9, 16, 25, 36]]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_each_view_has_an_owner_and_nobody_more_than_a_share(count: int) -> None:
    """Photos stay with their worker where that is even; the owners depend on the views of the step alone."""
    rng = torch.Generator().manual_seed(count)
    for batch in (1, 4, 5, 16):
        views = torch.randperm(40, generator=rng)[:batch].tolist()
        chosen = owners(views, count)
        loads = [chosen.count(rank) for rank in range(count)]
        assert sum(loads) == batch
        assert max(loads) == -(-batch // count)
    even = list(range(3 * count))
    assert owners(even, count) == [view % count for view in even]


def test_workers_read_their_own_photos(crew: Crew) -> None:
    """Each checks its part of them, and in steps reads the views that it draws, and some ahead; nobody needs all."""
    (alone,), runs = crew.act(1, shared_runs.photos_read, 4), crew.act(4, shared_runs.photos_read, 4)
    photos, drawn = alone["photos"], 4 * shared_runs.ITERATIONS
    assert alone["checked"] == list(range(photos))
    assert [run["checked"] for run in runs] == [list(range(rank, photos, 4)) for rank in range(4)]
    assert len(alone["made"]) >= drawn / 2
    assert sum(len(run["made"]) for run in runs) <= drawn + 4 * stepper.READ_AHEAD
    assert all(0 < len(run["made"]) < drawn / 2 for run in runs)


def test_a_message_gives_back_every_bit() -> None:
    """Negative zeros, NaN, booleans, integers, rows that are all zero, nothing at all, and numbers without a shape."""
    tensors: dict[str, Any] = {
        "gradient.0.vertices": torch.zeros(50, 3, 3),
        "signed": torch.tensor([[0.0, 0.0], [-0.0, 0.0], [float("nan"), 1.0]]),
        "seen": torch.arange(11) % 3 == 1,
        "count": torch.arange(5, dtype=torch.int32),
        "loss": torch.tensor(0.25),
        "none": torch.zeros(0, 4),
        "double": torch.tensor([1e-300, 0.0], dtype=torch.float64),
    }
    tensors["gradient.0.vertices"][7, 1] = 3.0
    message = pack(tensors)
    found = unpack(message)
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert (found[name].dtype, found[name].shape) == (tensor.dtype, tensor.shape)
        assert found[name].numpy().tobytes() == tensor.numpy().tobytes(), name
    sparse = torch.zeros(10_000, 9)
    sparse[:100] = 1.0
    assert len(pack({"gradient": sparse})) < 100 * 36 + 10_000 / 8 + 400
    assert pickle.loads(pickle.dumps(InputError("a: b"))).args == ("a: b",)
