"""Sums and copies by index of the CPU engine."""

import numpy as np
import pytest
import torch

from etsplat import _native
from etsplat.engines.native.pool import copied_indices
from etsplat.engines.threads import num_threads, set_num_threads


@pytest.mark.sanitize
@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize(("count", "rows"), [(0, 4), (1, 1), (7, 3), (70_001, 2), (70_001, 9_000)])
def test_rows_are_added_in_their_order_for_any_number_of_threads(count, rows, channels, rng):
    """What float32 sums in any other order would miss: numpy adds one row after the other."""
    values = torch.randn(count, channels, generator=rng)
    indices = torch.randint(rows, (count,), generator=rng, dtype=torch.int32)
    expected = np.zeros((rows, channels), np.float32)
    np.add.at(expected, indices.numpy(), values.numpy())
    before = num_threads()
    for threads in (1, 2, 3, 8):
        set_num_threads(threads)
        sums = torch.full((rows, channels), torch.nan)
        _native.sum_by_index(values=values, indices=indices, sums=sums)
        assert np.array_equal(sums.numpy(), expected)
    set_num_threads(before)


@pytest.mark.sanitize
@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("shape", [(0, 3), (7, 3), (30_000, 3)])
def test_rows_are_gathered(channels, shape, rng):
    values = torch.randn(9_000, channels, generator=rng)
    indices = torch.randint(len(values), shape, generator=rng, dtype=torch.int32)
    rows = torch.full((*shape, channels), torch.nan)
    _native.gather_rows(values=values, indices=indices, rows=rows)
    assert torch.equal(rows, values[indices.long()])


@pytest.mark.sanitize
@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("shape", [(0, 3), (5, 3), (40_000, 3)])
def test_copied_indices_are_int32_and_their_own(shape, dtype, rng):
    indices = torch.randint(2**31 - 1, shape, generator=rng, dtype=dtype)
    copies = copied_indices(indices)
    assert copies.dtype == torch.int32
    assert copies.shape == shape
    assert torch.equal(copies.long(), indices.long())
    copies.fill_(-1)
    assert bool((indices >= 0).all())
