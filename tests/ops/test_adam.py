import pytest
import torch

import etsplat
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.ops.adam import Adam
from helpers.engines import device_of, dtype_of, on

SHAPES = {"vertices": (1001, 3), "colors": (20011, 3), "sigma": (), "empty": (0, 3)}
RATES = {"vertices": 1e-3, "colors": 5e-2, "sigma": 2e-2, "empty": 1.0}


def parameters(rng: torch.Generator, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    return {name: torch.randn(shape, generator=rng, dtype=dtype).requires_grad_() for name, shape in SHAPES.items()}


def copies(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().clone().requires_grad_() for name, tensor in tensors.items()}


def set_gradients(rng: torch.Generator, *families: dict[str, torch.Tensor]) -> None:
    for name, parameter in families[0].items():
        gradient = torch.randn(parameter.shape, generator=rng) * 10 ** torch.randn(parameter.shape, generator=rng)
        gradient[torch.rand(parameter.shape, generator=rng) < 0.3] = 0
        for family in families:
            family[name].grad = gradient.to(family[name])


@pytest.mark.sanitize
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_torch_adam_within_rounding(engine, rng, dtype):
    """Several steps, with rows of zero gradient and a learning rate that changes, match torch.optim.Adam."""
    if dtype == torch.float64 and dtype_of(engine) == torch.float32:
        pytest.skip("native engines compute in float32")
    ours = {name: p.detach().to(device_of(engine)).requires_grad_() for name, p in parameters(rng, dtype).items()}
    theirs = copies(ours)
    adam = Adam(ours, RATES)
    expected = torch.optim.Adam([{"params": [theirs[n]], "lr": RATES[n], "name": n} for n in theirs], eps=1e-15)
    for step in range(12):
        set_gradients(rng, ours, theirs)
        if step == 6:
            adam.learning_rates["colors"] = expected.param_groups[1]["lr"] = 1e-2
        on(engine, adam.step)
        expected.step()
    assert adam.step_count == 12
    tolerance = {"rtol": 2e-5, "atol": 2e-6} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-12}
    for name in SHAPES:
        torch.testing.assert_close(ours[name], theirs[name], **tolerance)
        torch.testing.assert_close(adam.first_moments[name], expected.state[theirs[name]]["exp_avg"], **tolerance)


@pytest.mark.sanitize
@pytest.mark.parametrize("shape", [(4001, 3), (300, 3, 3), (3, 5000), (7,), (0, 3)])
def test_rows_move_at_their_own_pace(engine, rng, shape):
    """As far as all the others, times the factor of the row; moments know nothing of it."""
    start = torch.randn(shape, generator=rng).to(dtype_of(engine))
    gradients = [torch.randn(shape, generator=rng) for _ in range(3)]
    paces = 10 ** torch.rand(shape[0], generator=rng)
    ends = []
    for paced in (True, False):
        parameter = start.to(device_of(engine), copy=True).requires_grad_()
        adam = Adam({"p": parameter}, {"p": 0.01})
        if paced:
            adam.paces["p"] = paces.to(parameter)
        for gradient in gradients:
            parameter.grad = gradient.to(parameter)
            on(engine, adam.step)
        ends.append((parameter.detach().cpu() - start, adam.first_moments["p"].cpu(), adam.second_moments["p"].cpu()))
    (moved, *moments), (usual, *expected) = ends
    factors = paces.to(usual).reshape(-1, *[1] * (len(shape) - 1))
    torch.testing.assert_close(moved, factors * usual, rtol=1e-5, atol=1e-5)  # positions of some units are rounded
    assert all(torch.equal(*pair) for pair in zip(moments, expected, strict=True))


@pytest.mark.sanitize
def test_calmed_rows_with_small_gradients_move_little(engine, rng):
    """As far as others, times r^2 / (r^2 + (mean r)^2) of the moments before the step; without any, not at all."""
    size = torch.tensor([1.0, 0.1, 0.0]).repeat(100)[:, None]
    gradients = [size * torch.randn((300, 3), generator=rng) for _ in range(2)]
    moved, roots = [], []
    for calmed in (True, False):
        parameter = torch.zeros(300, 3, dtype=dtype_of(engine), device=device_of(engine)).requires_grad_()
        adam = Adam({"p": parameter}, {"p": 0.01})
        for step, gradient in enumerate(gradients):
            adam.calmed = frozenset({"p"}) if calmed else frozenset()
            parameter.grad = gradient.to(parameter)
            before = parameter.detach().cpu().clone()
            roots.append(adam.second_moments["p"].cpu().sum(dim=1).sqrt())
            on(engine, adam.step)
            moved.append((step, calmed, parameter.detach().cpu() - before))
    steps = {(step, calmed): by for step, calmed, by in moved}
    assert torch.equal(steps[0, True], torch.zeros_like(steps[0, True]))
    root = roots[1]
    expected = (root**2 / (root**2 + root.mean() ** 2))[:, None] * steps[1, False]
    torch.testing.assert_close(steps[1, True], expected, rtol=1e-4, atol=1e-7)
    assert bool((steps[1, True][2::3] == 0).all())


@pytest.mark.sanitize
def test_rows_with_paces_decay_as_others_do(engine, rng):
    """A step of both goes as far as one of the decay alone, times the factor of the row."""
    start, gradient = (torch.randn((500, 3, 3), generator=rng).to(dtype_of(engine)) for _ in range(2))
    paces, moved = 10 ** torch.rand(500, generator=rng).to(start), []
    for factors in (paces, None):
        parameter = start.to(device_of(engine), copy=True).requires_grad_()
        adam = Adam({"p": parameter}, {"p": 0.01})
        if factors is not None:
            adam.paces["p"] = factors.to(parameter)
        parameter.grad = gradient.to(parameter)
        on(engine, adam.step, {"p": 3.0})
        moved.append(parameter.detach().cpu() - start)
    torch.testing.assert_close(moved[0], paces[:, None, None] * moved[1], rtol=1e-5, atol=1e-5)
    against = torch.where(gradient + 3.0 * start > 0, -0.01, 0.01).to(start)
    torch.testing.assert_close(moved[1], against, rtol=1e-4, atol=1e-6)


def test_paces_must_fit_and_go_with_the_rows_that_they_were_for(rng):
    """Nothing is updated where they do not fit; a parameter of another length has none."""
    parameter = torch.zeros(4, 3, requires_grad=True)
    adam = Adam({"p": parameter}, {"p": 0.1})
    parameter.grad = torch.ones_like(parameter)
    adam.paces["p"] = torch.ones(5)
    with pytest.raises(ValueError, match="paces of p"):
        adam.step()
    assert adam.step_count == 0
    assert not parameter.any()
    adam.paces["p"] = torch.full((4,), 2.0)
    adam.replace("p", torch.zeros(4, 3, requires_grad=True), torch.zeros(4, 3), torch.zeros(4, 3))
    assert adam.paces["p"].tolist() == [2.0] * 4
    adam.replace("p", torch.zeros(6, 3, requires_grad=True), torch.zeros(6, 3), torch.zeros(6, 3))
    assert not adam.paces


def test_first_step_moves_by_the_learning_rate(engine):
    """After one step every element with a gradient has moved by lr against its sign, whatever its size."""
    parameter = torch.zeros(5, requires_grad=True, device=device_of(engine))
    parameter.grad = torch.tensor([1e-6, -3.0, 0.0, 1e4, -1e-3]).to(parameter)
    on(engine, Adam({"p": parameter}, {"p": 0.25}).step)
    torch.testing.assert_close(parameter.detach().cpu(), torch.tensor([-0.25, 0.25, 0.0, -0.25, 0.25]))


@pytest.mark.sanitize
def test_a_decay_adds_a_multiple_of_the_parameter_to_its_gradient(engine, rng):
    """To the bit, over several steps; other parameters have none."""
    ours = {name: p.detach().to(device_of(engine)).requires_grad_() for name, p in parameters(rng).items()}
    theirs = copies(ours)
    adam, expected = Adam(ours, RATES), Adam(theirs, RATES)
    for _ in range(3):
        set_gradients(rng, ours, theirs)
        for name in ("colors", "sigma"):
            theirs[name].grad = theirs[name].grad + 0.3 * theirs[name].detach()
        on(engine, adam.step, {"colors": 0.3, "sigma": 0.3})
        on(engine, expected.step)
    assert all(torch.equal(ours[name], theirs[name]) for name in SHAPES)


def test_a_decay_of_no_parameter_is_refused(rng):
    """Before anything is updated."""
    ours = parameters(rng)
    set_gradients(rng, ours)
    adam = Adam(ours, RATES)
    with pytest.raises(
        ValueError, match=r"^decays must be of \['colors', 'empty', 'sigma', 'vertices'\], got \['colours'\]"
    ):
        adam.step({"colours": 0.1})
    assert adam.step_count == 0


@pytest.mark.sanitize
def test_same_bits_for_any_number_of_threads(rng):
    """Elements are independent of one another and of the threads."""
    start = parameters(rng)
    before = num_threads()
    results = []
    for count in (1, 2, 5):
        set_num_threads(count)
        ours = copies(start)
        adam = Adam(ours, RATES)
        generator = torch.Generator().manual_seed(1)
        for _ in range(3):
            set_gradients(generator, ours)
            adam.step()
        results.append(ours)
    set_num_threads(before)
    assert all(torch.equal(result[name], results[0][name]) for result in results[1:] for name in SHAPES)


def test_state_dict_continues_to_the_bit(rng):
    """An optimizer restored in the middle ends where the uninterrupted one does."""
    ours = parameters(rng)
    adam = Adam(ours, RATES)
    adam.paces["vertices"] = torch.rand(1001, generator=rng)
    set_gradients(rng, ours)
    adam.step()
    resumed = copies(ours)
    second = Adam(resumed, dict.fromkeys(RATES, 1.0))
    second.load_state_dict(adam.state_dict())
    set_gradients(rng, ours, resumed)
    adam.step()
    second.step()
    assert second.step_count == 2
    assert all(torch.equal(ours[name], resumed[name]) for name in SHAPES)


def test_replace_puts_in_other_tensors_with_their_moments(rng):
    """After a structural edit the new rows step with the moments that were handed over."""
    ours = {"p": torch.randn((4, 3), generator=rng).requires_grad_()}
    adam = Adam(ours, {"p": 0.1})
    ours["p"].grad = torch.randn((4, 3), generator=rng)
    adam.step()
    index = torch.tensor([0, 2, 2, 3, 1])
    grown = ours["p"].detach()[index].requires_grad_()
    adam.replace("p", grown, adam.first_moments["p"][index], adam.second_moments["p"][index])
    gradient = torch.randn((4, 3), generator=rng)
    grown.grad = gradient[index]
    adam.step()
    assert torch.equal(grown[1], grown[2])
    with pytest.raises(ValueError, match="first"):
        adam.replace("p", grown, torch.zeros(4, 3), torch.zeros(5, 3))
    with pytest.raises(ValueError, match="name"):
        adam.replace("q", grown, torch.zeros(5, 3), torch.zeros(5, 3))


def test_non_contiguous_parameters_and_gradients(rng):
    """A transposed parameter with a strided gradient is updated as its contiguous copy is."""
    storage = torch.randn((3, 50), generator=rng)
    gradient = torch.randn((50, 6), generator=rng)[:, ::2]
    strided, plain = storage.T.clone(memory_format=torch.preserve_format), storage.T.contiguous()
    assert not strided.is_contiguous()
    for parameter in (strided, plain):
        parameter.requires_grad_()
        parameter.grad = gradient
        Adam({"p": parameter}, {"p": 0.1}).step()
    assert torch.equal(strided, plain)


def test_a_stale_graph_fails_loudly(rng):
    """Backward through values that a step has overwritten is an error, not a wrong gradient."""
    parameter = torch.randn((5,), generator=rng).requires_grad_()
    loss = (parameter**2).sum()
    loss.backward(retain_graph=True)
    Adam({"p": parameter}, {"p": 0.1}).step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_missing_gradients_and_wrong_names_are_errors(rng):
    """A parameter without gradient stops the step before anything is changed."""
    ours = parameters(rng)
    with pytest.raises(ValueError, match="learning_rates"):
        Adam(ours, {"vertices": 0.1})
    with pytest.raises(ValueError, match=r"learning_rates must name .* got 0\.1"):
        Adam(ours, 0.1)
    with pytest.raises(ValueError, match="parameters must be tensors by name, got list"):
        Adam(list(ours.values()), RATES)
    with pytest.raises(ValueError, match="betas"):
        Adam(ours, RATES, betas=(0.9, 1.0))
    adam = Adam(ours, RATES)
    set_gradients(rng, ours)
    ours["sigma"].grad = None
    start = ours["vertices"].detach().clone()
    with pytest.raises(ValueError, match="sigma has no gradient"):
        adam.step()
    assert torch.equal(start, ours["vertices"])
    adam.zero_grad()
    assert all(parameter.grad is None for parameter in ours.values())
    with pytest.raises(ValueError, match="first_moments"):
        adam.load_state_dict({**adam.state_dict(), "first_moments": {}})


def test_what_requires_no_gradient_stays_as_it_is(engine, rng):
    """Until it has one again; the others step as they would alone."""
    device = device_of(engine)
    both = {name: torch.randn(4, 3, generator=rng).to(device) for name in ("frozen", "free")}
    both["free"].requires_grad_()
    alone = {"free": both["free"].detach().clone().requires_grad_()}
    before = both["frozen"].clone()
    two, one = (Adam(tensors, dict.fromkeys(tensors, 0.1)) for tensors in (both, alone))
    with etsplat.engine(engine):
        for adam, tensors in ((two, both), (one, alone)):
            tensors["free"].square().sum().backward()
            adam.step()
        assert both["frozen"].equal(before)
        assert both["free"].equal(alone["free"])
        both["frozen"].requires_grad_().sum().backward()
        two.step()
    assert not both["frozen"].equal(before)


def test_parameters_without_a_place_for_each_element_are_refused_before_anything_changes():
    expanded = torch.rand(1).expand(7)
    for odd, text in (
        (expanded, "a place for each element"),
        ((), "a tensor"),
        (torch.rand(7).to("meta"), "in memory"),
    ):
        with pytest.raises(ValueError, match=rf"parameters\[value\] must (be|have) {text}"):
            Adam({"value": odd}, {"value": 0.1})
    first, second = torch.ones(7), torch.ones(7)
    first.grad, second.grad = torch.ones(7), torch.ones(7)
    adam = Adam({"first": first, "second": second}, {"first": 0.1, "second": 0.1})
    second.data = expanded
    with pytest.raises(ValueError, match=r"parameters\[second\] must have a place for each element"):
        adam.step()
    assert adam.step_count == 0
    assert torch.equal(first, torch.ones(7))
    with pytest.raises(ValueError, match="parameter must have a place for each element"):
        adam.replace("first", expanded, first, first)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, "state must be what state_dict.. of an etsplat.Adam returns, got one without betas, .*step_count"),
        (torch.optim.Adam([torch.zeros(2)]).state_dict(), "without betas, .*: it is of torch.optim"),
        ([], "state must be .*, got list"),
    ],
)
def test_a_state_of_something_else_is_named(state, message):
    """It was a KeyError."""
    with pytest.raises(ValueError, match=message):
        Adam({"p": torch.zeros(2)}, {"p": 0.1}).load_state_dict(state)


def test_it_says_its_rates_in_a_line():
    assert repr(Adam({"p": torch.zeros(2)}, {"p": 0.1})) == "Adam(p: 0.1; 0 steps)"
