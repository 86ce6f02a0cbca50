"""Values of arguments are checked the same on native arrays and on any other tensor."""

import numpy as np
import pytest
import torch

from etsplat.core.validation import check_count, check_finite, check_indices, check_positive, first_not_finite
from etsplat.engines.native.pool import zeros_image

LARGE = 100_000  # several ranges of the native scans


def layouts(tensor):
    """Read natively, and by torch: another dtype, another layout."""
    wide = torch.int64 if tensor.dtype == torch.int32 else torch.float64
    return [tensor, tensor.to(wide), torch.stack([tensor, tensor], dim=1)[:, 0]]


@pytest.mark.sanitize
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_are_counted(bad):
    values = torch.linspace(-1e38, 1e38, LARGE)
    for tensor in layouts(values):
        check_finite("x", tensor)
    values[[0, 40_000, LARGE - 1]] = bad
    for tensor in layouts(values):
        with pytest.raises(ValueError, match="x must be finite, got 3 NaN or infinite values"):
            check_finite("x", tensor)


@pytest.mark.sanitize
@pytest.mark.parametrize("place", [0, 40_000, LARGE - 1])
def test_the_smallest_value_decides_whether_all_are_positive(place):
    values = torch.full((LARGE,), 0.5)
    for tensor in layouts(values):
        check_positive("x", tensor)
    values[place] = -0.25
    for tensor in layouts(values):
        with pytest.raises(ValueError, match=r"x must be positive, got -0\.25"):
            check_positive("x", tensor)


@pytest.mark.sanitize
@pytest.mark.parametrize(("place", "index"), [(0, -1), (40_000, 7), (LARGE - 1, -5), (5, -(2**31)), (9, 2**31 - 1)])
def test_indices_out_of_range_are_found(place, index):
    indices = torch.arange(LARGE, dtype=torch.int32) % 7
    for tensor in layouts(indices):
        check_indices("faces", tensor, 7)
    indices[place] = index
    message = f"got indices from {min(index, 0)} to {max(index, 6)}"
    for tensor in layouts(indices):
        with pytest.raises(ValueError, match=message):
            check_indices("faces", tensor, 7)


@pytest.mark.sanitize
@pytest.mark.parametrize("index", [2**32, 2**63 - 1, -(2**63)])
def test_indices_are_not_cut_to_32_bits_before_they_are_looked_at(index):
    with pytest.raises(ValueError, match=f"got indices from {min(index, 3)} to {max(index, 3)}"):
        check_indices("faces", torch.tensor([3, index]), 2**31)


def test_no_index_is_right_where_there_is_nothing():
    with pytest.raises(ValueError, match="got indices from 0 to 0"):
        check_indices("faces", torch.zeros(2, dtype=torch.int32), 0)


def test_empty_tensors_pass():
    check_finite("x", torch.empty(0))
    check_positive("x", torch.empty(0))
    check_indices("x", torch.empty(0, dtype=torch.int32), 0)


@pytest.mark.parametrize("shape", [(), (3,), (LARGE, 3)])
def test_recycled_memory_is_zeroed(shape):
    for _ in range(3):
        zeros = zeros_image(*shape)
        assert zeros.shape == shape
        assert torch.equal(zeros, torch.zeros(shape))
        zeros += 1


def test_a_tensor_that_is_not_finite_is_named():
    """NaN and infinity are found in any precision; the first name is given."""
    tensors = {"a": torch.ones(3), "b": torch.tensor([1.0, torch.inf]), "c": torch.full((2,), torch.nan).double()}
    assert first_not_finite(tensors) == "b"
    assert first_not_finite({"a": tensors["a"], "c": tensors["c"]}) == "c"
    assert first_not_finite({"a": tensors["a"]}) is None


@pytest.mark.parametrize("count", [3, np.int64(3), np.uint8(3), np.array(3), torch.tensor(3), torch.tensor(3).short()])
def test_whole_numbers_of_every_library_are_ints(count):
    """As shapes and loops of others give them."""
    found = check_count("count", count, most=4)
    assert (found, type(found)) == (3, int)


@pytest.mark.parametrize(
    "count", [3.0, True, np.bool_(True), torch.tensor(True), torch.tensor(3.0), torch.tensor([3]), np.array([3]), "3"]
)
def test_what_is_no_whole_number_is_no_count(count):
    with pytest.raises(ValueError, match="count must be an integer of at least 1, got"):
        check_count("count", count)
