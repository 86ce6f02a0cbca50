"""Schedules of weights, learning rates and views."""

import math

import pytest
import torch

from etsplat.ops.adam import Adam
from etsplat.optim.schedules import begun_anew, exponential_decay, face_budgets, late_decay, regularization_weight
from etsplat.optim.view_sampler import ViewSampler


def test_regularization_is_full_until_step_500_and_nothing_at_the_last_step() -> None:
    """The paper's numbers: 1 up to step 500, 0 at step 30,000, halfway between the two one half."""
    assert [regularization_weight(t, 30_000, 500) for t in (1, 499, 500)] == [1.0, 1.0, 1.0]
    assert regularization_weight(15_250, 30_000, 500) == pytest.approx(0.5)
    assert regularization_weight(30_000, 30_000, 500) == 0.0


def test_regularization_follows_a_cosine() -> None:
    """A quarter of the way down, gamma is (1 + cos(pi / 4)) / 2."""
    assert regularization_weight(500 + 29_500 // 4, 30_000, 500) == pytest.approx(0.5 * (1 + math.cos(math.pi / 4)))


def test_regularization_of_a_run_shorter_than_the_hold_stays_full() -> None:
    """A run of 100 steps with hold 500 keeps gamma = 1 and divides by nothing."""
    assert regularization_weight(100, 100, 500) == 1.0


def test_learning_rates_fall_exponentially() -> None:
    """The factor is 1 at the first step, the ratio at the last, and its logarithm is linear between."""
    factors = [exponential_decay(t, 101, 0.01) for t in (1, 51, 101)]
    assert factors == pytest.approx([1.0, 0.1, 0.01])
    assert exponential_decay(1, 1, 0.01) == 1.0


def test_a_late_fall_travels_half_as_far_again_and_ends_as_low() -> None:
    """Above the exponential for two thirds of a run, below it from there on, and the same at both ends."""
    late, early = ([fall(t, 1001, 0.02) for t in range(1, 1002)] for fall in (late_decay, exponential_decay))
    assert (late[0], late[-1]) == pytest.approx((1.0, 0.02))
    assert sum(late) / sum(early) == pytest.approx(1.5, abs=0.1)
    assert late[250] > 1.5 * early[250]
    assert late[900] < early[900]
    assert sorted(late, reverse=True) == late
    assert late_decay(1, 1, 0.02) == 1.0


def test_steps_with_moments_begun_anew_are_those_of_a_new_run() -> None:
    """Adam corrects moments for the steps since the start of a run; the factor on the rate makes up for it."""
    gradients = [torch.tensor([1.0, -3.0]), torch.tensor([0.5, 2.0]), torch.tensor([-1.0, 0.1])]
    moved = []
    for before in (0, 5):
        place = torch.zeros(2, dtype=torch.float64, requires_grad=True)
        adam = Adam({"p": place}, {"p": 0.0})
        for _ in range(before):
            place.grad = torch.ones_like(place)
            adam.step()
        adam.forget("p")
        for number, gradient in enumerate(gradients, start=before + 1):
            place.grad = gradient.double()
            adam.learning_rates["p"] = 0.1 * begun_anew(number, before + 1, adam.betas)
            adam.step()
        moved.append(place.detach())
    torch.testing.assert_close(*moved)


def test_every_epoch_shows_each_view_once_in_a_new_order() -> None:
    """Three epochs are three different permutations of the views."""
    views = [3, 5, 8, 13, 21, 34, 55, 89]
    sampler = ViewSampler(views, torch.Generator().manual_seed(0))
    epochs = [tuple(sampler.next_view() for _ in views) for _ in range(3)]
    assert all(sorted(epoch) == views for epoch in epochs)
    assert len(set(epochs)) == 3


def test_a_sampler_continues_from_its_state_in_the_middle_of_an_epoch() -> None:
    """After loading a state, views and backgrounds are those that would have come, to the bit."""
    sampler = ViewSampler(range(7), torch.Generator().manual_seed(1))
    for _ in range(10):
        sampler.next_view()
    state = {name: tensor.clone() for name, tensor in sampler.state().items()}
    expected = [(sampler.next_view(), sampler.background().tolist()) for _ in range(20)]
    other = ViewSampler(range(7), torch.Generator().manual_seed(2))
    other.load_state(state)
    assert [(other.next_view(), other.background().tolist()) for _ in range(20)] == expected


def test_faces_grow_by_the_same_factor_up_to_the_limit() -> None:
    """Four subdivisions from 100 to 1600 faces double them, at evenly spaced iterations."""
    budgets = face_budgets(1000, steps=4, first=0.1, last=0.7, start_faces=100, max_faces=1600)
    assert budgets == {100: 200, 300: 400, 500: 800, 700: 1600}


def test_a_mesh_with_enough_faces_is_not_subdivided() -> None:
    """At or above the limit there is no subdivision, and none if none is asked for."""
    assert face_budgets(1000, steps=4, first=0.1, last=0.7, start_faces=2000, max_faces=1600) == {}
    assert face_budgets(1000, steps=0, first=0.1, last=0.7, start_faces=100, max_faces=1600) == {}


def test_subdivisions_of_a_very_short_run_stay_within_it() -> None:
    """With more subdivisions than iterations, iterations stay in 1..2 and the last budget is the limit."""
    budgets = face_budgets(2, steps=10, first=0.0, last=1.0, start_faces=100, max_faces=1600)
    assert list(budgets) == [1, 2]
    assert budgets[2] == 1600
