import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import face_areas
from etsplat.geometry.subdivision import longest_edge_plan
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.adam import Adam
from etsplat.optim.edit import RowPlan, apply_rows, apply_sources, apply_subdivision

RATES = {"vertices": 1e-2, "colors": 1e-1, "opacities": 1e-1, "sigma": 1e-3}


@pytest.fixture
def problem(rng):
    """A sphere with parameters that have taken three steps, and a plan that splits half of it."""
    vertices, faces = icosphere(2)
    parameters = {
        "vertices": vertices,
        "colors": torch.rand(len(faces), 3, generator=rng),
        "opacities": torch.rand(len(faces), generator=rng),
        "sigma": torch.tensor(0.5),
    }
    adam = Adam({name: tensor.requires_grad_() for name, tensor in parameters.items()}, RATES)
    for _ in range(3):
        take_step(adam, rng)
    topology = MeshTopology.from_faces(faces, len(vertices))
    points = adam.parameters["vertices"].detach()
    return adam, longest_edge_plan(points, topology, face_areas(points, faces), 480)


def take_step(adam, rng):
    for parameter in adam.parameters.values():
        parameter.grad = torch.randn(parameter.shape, generator=rng)
    adam.step()


def subdivide(plan, adam, statistics=None, per_face=("colors", "opacities")):
    return apply_subdivision(plan, adam, per_vertex=("vertices",), per_face=per_face, statistics=statistics)


def snapshot(adam):
    tables = adam.parameters, adam.first_moments, adam.second_moments
    return {name: [table[name].detach().clone() for table in tables] for name in adam.parameters}


def test_values_and_moments_move_together(problem):
    """Midpoints get the mean of their ends, children a copy of their parent: values and both moments alike."""
    adam, plan = problem
    before = snapshot(adam)
    subdivide(plan, adam)
    after = snapshot(adam)
    first, second = plan.new_vertices.unbind(1)
    for old, new in zip(before["vertices"], after["vertices"], strict=True):
        assert torch.equal(new[: len(old)], old)
        torch.testing.assert_close(new[len(old) :], (old[first] + old[second]) / 2)
    for name in ("colors", "opacities"):
        for old, new in zip(before[name], after[name], strict=True):
            assert torch.equal(new, old[plan.parent_face])
    for old, new in zip(before["sigma"], after["sigma"], strict=True):
        assert torch.equal(new, old)
    assert adam.step_count == 3


def test_the_returned_parameters_are_the_optimizer_s(problem, rng):
    """The tensors that come back are trainable leaves, and the next step moves them."""
    adam, plan = problem
    new = subdivide(plan, adam)
    assert list(new) == ["vertices", "colors", "opacities"]
    for name, tensor in new.items():
        assert adam.parameters[name] is tensor
        assert tensor.is_leaf
        assert tensor.requires_grad
    before = snapshot(adam)
    take_step(adam, rng)
    for name, tensor in adam.parameters.items():
        assert not torch.equal(tensor, before[name][0])


def test_children_without_gradient_go_on_like_their_parent(problem):
    """With zero gradients the momentum carries both children as far as it would have carried the parent."""
    adam, plan = problem
    colors = adam.parameters["colors"].detach().clone()
    twin = Adam({"colors": colors.clone().requires_grad_()}, {"colors": RATES["colors"]})
    twin.load_state_dict(
        {
            **adam.state_dict(),
            "learning_rates": {"colors": RATES["colors"]},
            "first_moments": {"colors": adam.first_moments["colors"]},
            "second_moments": {"colors": adam.second_moments["colors"]},
        }
    )
    subdivide(plan, adam)
    for optimizer in (adam, twin):
        for parameter in optimizer.parameters.values():
            parameter.grad = torch.zeros_like(parameter)
        optimizer.step()
    torch.testing.assert_close(adam.parameters["colors"], twin.parameters["colors"][plan.parent_face])


def test_statistics_are_carried_too(problem):
    """Integer and float statistics per face follow the faces, and stay plain tensors."""
    adam, plan = problem
    seen = torch.arange(plan.num_faces)
    new = subdivide(plan, adam, {"seen": seen}, per_face=("colors", "opacities", "seen"))
    assert torch.equal(new["seen"], plan.parent_face)
    assert not new["seen"].requires_grad


def test_empty_plan_changes_no_value(problem):
    """A plan that splits nothing leaves every value as it is."""
    adam, plan = problem
    topology = MeshTopology.from_faces(icosphere(2)[1], plan.num_vertices)
    empty = longest_edge_plan(adam.parameters["vertices"], topology, torch.ones(plan.num_faces), 0)
    assert empty.is_empty
    before = snapshot(adam)
    subdivide(empty, adam)
    for name, tables in snapshot(adam).items():
        assert all(torch.equal(old, new) for old, new in zip(before[name], tables, strict=True))


@pytest.mark.parametrize(
    ("per_face", "statistics", "message"),
    [
        (("colors", "opacity"), None, "got 'opacity'"),
        (("colors", "vertices"), None, "name each tensor once"),
        (("colors", "sigma"), None, r"sigma must have 320 rows as the plan, got shape \(\)"),
        (("colors", "seen"), {"seen": torch.zeros(7)}, r"seen must have 320 rows"),
        (("colors",), {"seen": torch.zeros(320)}, "name every statistic"),
    ],
)
def test_bad_names_and_shapes_change_nothing(problem, per_face, statistics, message):
    """Unknown, repeated or misshapen tensors raise before anything has been moved."""
    adam, plan = problem
    before = dict(adam.parameters)
    with pytest.raises(ValueError, match=message):
        subdivide(plan, adam, statistics, per_face)
    assert all(adam.parameters[name] is tensor for name, tensor in before.items())


def freed(tensor: torch.Tensor) -> torch.Tensor:
    """Without its memory, which to read ends the process."""
    tensor.untyped_storage().resize_(0)
    return tensor


@pytest.mark.parametrize(
    ("kept", "text"),
    [
        (None, "kept must be a tensor"),
        (freed(torch.ones(4) > 0), "kept must have memory of its own"),
        (torch.ones(4), "kept must be of bools"),
        (torch.ones(4, 1) > 0, "kept must have shape"),
    ],
)
def test_rows_to_keep_that_are_no_flags_are_refused(kept, text):
    with pytest.raises(ValueError, match=text):
        RowPlan.keeping(kept)


@pytest.mark.parametrize(
    ("odd", "text"),
    [
        ({"source": torch.tensor([0, 4])}, "source must be indices from 0 to 3, got indices from 0 to 4"),
        ({"source": torch.tensor([0.0, 1.0])}, "source must be int32 or int64"),
        ({"fresh": torch.tensor([0, 1])}, "fresh must be of bools"),
        ({"fresh": torch.ones(3) > 0}, r"fresh must have shape \(2,\)"),
        ({"values": {"p": freed(torch.ones(1, 3))}}, "values of p must have memory of its own"),
    ],
)
def test_plans_that_cannot_be_are_refused_before_anything_changes(odd, text):
    plan = {"num_rows": 4, "source": torch.tensor([0, 1]), "fresh": torch.tensor([False, True])}
    value = torch.ones(4, 3)
    adam = Adam({"p": value}, {"p": 0.1})
    with pytest.raises(ValueError, match=text):
        apply_rows(RowPlan(**{**plan, **odd}), adam, {})
    assert adam.parameters["p"] is value


def test_gradients_of_what_an_edit_replaces_are_let_go(rng):
    """They would stand beside the copies; the next step makes new ones."""
    adam = Adam({"x": torch.rand(6, 2, generator=rng, requires_grad=True)}, {"x": 0.1})
    old = adam.parameters["x"]
    take_step(adam, rng)
    assert old.grad is not None
    first, second = adam.first_moments["x"].clone(), adam.second_moments["x"].clone()
    kept = torch.tensor([True, False, True, True, False, True])
    apply_rows(RowPlan.keeping(kept), adam, {})
    assert old.grad is None
    assert torch.equal(adam.first_moments["x"], first[kept])
    assert torch.equal(adam.second_moments["x"], second[kept])


def test_copies_of_rows_have_their_moments_and_bad_ones_change_nothing(problem):
    adam, _ = problem
    before, rows = snapshot(adam), torch.tensor([5, 2, 2])
    for wrong in ({"colors": rows, "color": rows}, {"colors": rows, "sigma": rows}, {"colors": torch.tensor([10_000])}):
        with pytest.raises((ValueError, IndexError)):
            apply_sources(wrong, adam)
        assert all(
            torch.equal(*pair)
            for name, tables in snapshot(adam).items()
            for pair in zip(tables, before[name], strict=True)
        )
    found = apply_sources({"colors": rows}, adam)
    assert adam.parameters["colors"] is found["colors"]
    assert found["colors"].requires_grad
    after = snapshot(adam)
    assert all(torch.equal(new, old[rows]) for new, old in zip(after["colors"], before["colors"], strict=True))
    assert all(torch.equal(new, old) for new, old in zip(after["vertices"], before["vertices"], strict=True))


def test_parameters_that_have_no_rows_stay_as_they_are(rng):
    """Even where they happen to have as many; those that are not named must fit the plan."""
    values = {"x": torch.rand(6, 2, generator=rng), "beside": torch.rand(6, 3, generator=rng)}
    adam = Adam({name: value.requires_grad_() for name, value in values.items()}, {"x": 0.1, "beside": 0.1})
    take_step(adam, rng)
    beside, first = values["beside"].detach().clone(), adam.first_moments["beside"].clone()
    plan = RowPlan.keeping(torch.tensor([True, False, True, True, False, True]))
    new, _ = apply_rows(plan, adam, {}, others=["beside"])
    assert set(new) == {"x"}
    assert len(adam.parameters["x"]) == 4
    assert adam.parameters["beside"] is values["beside"]
    assert torch.equal(adam.parameters["beside"], beside)
    assert torch.equal(adam.first_moments["beside"], first)
    with pytest.raises(ValueError, match="beside must have 4 rows"):
        apply_rows(RowPlan.keeping(torch.ones(4) > 0), adam, {})
