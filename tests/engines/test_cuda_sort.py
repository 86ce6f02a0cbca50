"""The radix sort of the GPU engine, by the shim and, where there is one, on a GPU."""

import pytest
import torch

from etsplat.engines.cuda.launch import device_type
from etsplat.engines.cuda.sort import RadixSort


def run(sort, keys, on_device=None):
    device = device_type()
    count = len(keys)
    buffers = [torch.full((sort.capacity,), -1, dtype=torch.int32, device=device) for _ in range(4)]
    buffers[0][:count] = keys.to(device)
    zeros = torch.zeros(sort.zeros, dtype=torch.int32, device=device)
    number = count if on_device is None else torch.tensor([count], dtype=torch.int32, device=device)
    sorted_keys, values = sort.run((buffers[0], buffers[1]), (buffers[2], buffers[3]), number, zeros)
    return sorted_keys[:count].cpu(), values[:count].cpu()


@pytest.mark.sanitize
@pytest.mark.parametrize("count", [0, 1, 31, 256, 2048, 2049, 9000])
@pytest.mark.parametrize("bits", [1, 9, 31])
def test_sorts_and_keeps_the_order_of_equal_keys(cuda_engine, count, bits, rng):
    """Keys of any width, one block and several; the values say where each key was."""
    keys = torch.randint(0, 2**bits, (count,), generator=rng).int()
    expected, order = torch.sort(keys, stable=True)
    sorted_keys, values = run(RadixSort(max(count, 1), bits), keys)
    assert torch.equal(sorted_keys, expected)
    assert torch.equal(values, order.int())


def test_number_of_pairs_on_the_device(cuda_engine, rng):
    """Less than there is room for, and not known to the host."""
    keys = torch.randint(0, 5000, (3000,), generator=rng).int()
    expected, order = torch.sort(keys, stable=True)
    sorted_keys, values = run(RadixSort(10000, 13), keys, on_device=True)
    assert torch.equal(sorted_keys, expected)
    assert torch.equal(values, order.int())


@pytest.mark.parametrize("keys", [torch.zeros(5000), torch.arange(5000).flip(0), torch.tensor([3.0, 1.0, 2.0])])
def test_extreme_distributions(cuda_engine, keys):
    expected, order = torch.sort(keys.int(), stable=True)
    sorted_keys, values = run(RadixSort(5000, 16), keys.int())
    assert torch.equal(sorted_keys, expected)
    assert torch.equal(values, order.int())
