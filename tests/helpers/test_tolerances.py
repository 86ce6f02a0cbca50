"""The helpers that compare tensors in other tests are themselves right."""

import pytest
import torch

from helpers.tolerances import assert_close_to_scale, error_to_scale


def test_error_is_measured_against_the_largest_expected_magnitude():
    error = error_to_scale(torch.tensor([1.0, -10.5]), torch.tensor([0.0, -10.0]))
    assert error.tolist() == pytest.approx([0.1, 0.05])


def test_a_given_scale_replaces_the_largest_magnitude():
    assert float(error_to_scale(torch.tensor([3.0]), torch.tensor([1.0]), scale=4.0)) == pytest.approx(0.5)


def test_within_tolerance_passes_and_beyond_fails():
    expected = torch.tensor([1.0, 100.0])
    assert_close_to_scale(torch.tensor([1.09, 100.0]), expected, 1e-3)
    with pytest.raises(AssertionError, match="worst error"):
        assert_close_to_scale(torch.tensor([1.2, 100.0]), expected, 1e-3)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_non_finite_values_always_fail(bad):
    with pytest.raises(AssertionError, match="inf"):
        assert_close_to_scale(
            torch.tensor([bad, 1.0]), torch.tensor([0.0, 1.0]), 1e9, outliers=1.0, outlier_tolerance=1e9
        )


def test_all_zero_expectation_accepts_only_zero():
    assert_close_to_scale(torch.zeros(3), torch.zeros(3), 1e-6)
    with pytest.raises(AssertionError):
        assert_close_to_scale(torch.full((3,), 1e-20), torch.zeros(3), 1e-6)


def test_outliers_are_bounded_in_number_and_in_size():
    expected = torch.ones(100)
    actual = expected.clone()
    actual[:2] = 1.05
    assert_close_to_scale(actual, expected, 1e-3, outliers=0.02, outlier_tolerance=0.1)
    with pytest.raises(AssertionError, match="2 elements"):
        assert_close_to_scale(actual, expected, 1e-3, outliers=0.01, outlier_tolerance=0.1)
    with pytest.raises(AssertionError, match="worst error"):
        assert_close_to_scale(actual, expected, 1e-3, outliers=0.02, outlier_tolerance=0.01)


def test_shapes_must_agree():
    with pytest.raises(AssertionError, match="shape"):
        assert_close_to_scale(torch.zeros(3, 1), torch.zeros(3), 1.0)


def test_empty_tensors_are_close():
    assert_close_to_scale(torch.zeros(0, 3), torch.zeros(0, 3), 0.0)
