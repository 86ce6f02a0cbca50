"""What maps explain of known depths, right and wrong ones."""

import math

import pytest
import torch

from etsplat.metrics.depth import FEWEST, depth_agreement

VIEWS = 5


def views(change, count=400):
    """Known depths between 2 and 4, and what a change makes of them, for some views."""
    rng = torch.Generator().manual_seed(0)
    depths = [2 + 2 * torch.rand(count, generator=rng) for _ in range(VIEWS)]
    return [(depth, change(depth, rng)) for depth in depths]


def outliers(depth, rng):
    wild = torch.rand(len(depth), generator=rng) < 0.1
    noisy = depth * (1 + 0.01 * torch.randn(len(depth), generator=rng))
    return torch.where(wild, 10 * torch.rand(len(depth), generator=rng), noisy)


def test_right_maps_explain_all_and_noise_costs_little():
    exact, noisy = depth_agreement(views(lambda d, _: d)), depth_agreement(views(outliers))
    assert exact.overall("l1") == 1
    assert exact.overall("pearson") == pytest.approx(1)
    assert exact.factor == 1
    assert noisy.overall("l1") > 0.9
    assert noisy.overall("pearson") > 0.85
    assert noisy.factor == pytest.approx(1, abs=0.01)


def test_another_unit_or_shift_is_right_up_to_scale_and_shift_alone():
    found = depth_agreement(views(lambda d, _: 0.5 * d + 3))
    assert found.overall("l1") < 0
    assert found.overall("pearson") == pytest.approx(1)
    assert not found.inverse
    assert depth_agreement(views(lambda d, _: d / 4)).factor == pytest.approx(4)


def test_maps_of_inverse_depths_are_told():
    found = depth_agreement(views(lambda d, _: 0.3 + 5 / d))
    assert found.inverse
    assert found.overall("pearson") == pytest.approx(1)


@pytest.mark.parametrize("wrong", [lambda d, rng: 2 + 2 * torch.rand(len(d), generator=rng), lambda d, _: 0 * d + 3])
def test_numbers_that_have_nothing_to_do_with_it_explain_nothing(wrong):
    """Nor does one number for all."""
    found = depth_agreement(views(wrong))
    assert found.overall("l1") < 0.05
    assert found.overall("pearson") < 0.1


def test_of_too_few_pixels_nothing_is_said():
    found = depth_agreement(views(lambda d, _: d, FEWEST - 1))
    assert found.overall("l1") == -math.inf
    assert math.isnan(found.factor)
    assert depth_agreement([]).overall("pearson") == -math.inf
