"""Steps of rows that are seen now and then."""

import math

import torch

from etsplat.optim.visit_steps import MEMORY, VisitSteps


def visited(values: torch.Tensor, gradient: list[list[float]]) -> torch.Tensor:
    values.grad = torch.tensor(gradient, dtype=values.dtype)
    return values


def test_all_numbers_of_a_row_have_one_length() -> None:
    """The first step is the gradient over the root of its mean square, times the rate."""
    values = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    VisitSteps(visited(values, [[3.0, 0.1], [-3e-9, 4e-9]])).step(0.5)
    root = math.sqrt((9.0 + 0.01) / 2)
    expected = torch.tensor([[-1.5 / root, -0.05 / root], [0.3 * math.sqrt(2), -0.4 * math.sqrt(2)]]).double()
    torch.testing.assert_close(values.detach(), expected, rtol=1e-6, atol=0)


def test_a_row_has_a_clock_of_its_own() -> None:
    """Steps that do not see it change neither it nor the length of its next step."""
    together, apart = (torch.zeros(2, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    both, each = VisitSteps(together), VisitSteps(apart)
    first, second, none = [1.0, -2.0, 0.5], [0.25, 0.0, -0.5], [0.0] * 3
    for row in (first, second):
        visited(together, [row, row])
        both.step(0.1)
    for rows in ([first, none], [none, first], [none, none], [second, none], [none, second]):
        visited(apart, rows)
        each.step(0.1)
    assert torch.equal(together, apart)
    was, now = (sum(x * x for x in row) / 3 for row in (first, second))
    root = math.sqrt((MEMORY * was + now) / (MEMORY + 1))
    assert math.isclose(float(apart.detach()[0, 2]), -0.1 * 0.5 / math.sqrt(was) + 0.1 * 0.5 / root, rel_tol=1e-12)


def test_a_halted_step_changes_nothing_and_nan_is_found() -> None:
    """What is not a number must reach the values, where the run looks for it."""
    values = torch.zeros(1, 2, requires_grad=True)
    steps = VisitSteps(visited(values, [[1.0, 2.0]]))
    steps.step(torch.tensor(0.1), torch.tensor(1, dtype=torch.int32))
    assert not values.any()
    assert not any(tensor.any() for tensor in steps.state().values())
    visited(values, [[math.nan, 2.0]])
    steps.step(0.1)
    assert values.isnan().any()
