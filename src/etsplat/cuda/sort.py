"""Stable radix sort of (key, value) pairs on the device: host side of csrc/cuda/radix_sort.cu."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program

_PROGRAM = Program("radix_sort.cu")
_DIGITS = 256
_BLOCK = 256
_TILE = 2048  # pairs of a block
_HISTOGRAM_GRID = 528  # blocks at most: four for each multiprocessor of the largest GPUs


@dataclass(frozen=True)
class RadixSort:
    """How up to ``capacity`` pairs are sorted by the low ``bits`` bits of their keys.

    Attributes:
        capacity: Most pairs, below 2^30.
        bits: Keys are below 2^bits, at most 32.
    """

    capacity: int
    bits: int

    @property
    def passes(self) -> int:
        """Number of digits; an odd number leaves the result in the second buffers."""
        return max(1, blocks(self.bits, 8))

    @property
    def zeros(self) -> int:
        """Words of zeroed memory that ``run`` needs."""
        return self.passes * (_DIGITS + _DIGITS * blocks(self.capacity, _TILE) + 1)

    def run(self, keys: tuple[Any, Any], values: tuple[Any, Any], count: Any, zeros: Tensor) -> tuple[Any, Any]:
        """Sort; both buffers of each pair are overwritten.

        Args:
            keys: Two buffers of ``capacity`` words, as tensors or addresses; the keys are in the first.
            values: Two buffers. The values that go in are each pair's place: 0, 1, ...
            count: The number of pairs: an int, or the address of one on the device.
            zeros: ``zeros`` words of 0.

        Returns:
            The buffers that hold the sorted keys and values.
        """
        on_device, number = (None, count) if isinstance(count, int) else (count, 0)
        digit_bits = blocks(self.bits, self.passes)
        grid = blocks(self.capacity, _TILE)
        histogram, tickets, states = zeros.split([self.passes * _DIGITS, self.passes, self.passes * _DIGITS * grid])
        histogram_grid = min(grid, _HISTOGRAM_GRID)
        arguments = [keys[0], on_device, number, self.passes, digit_bits, histogram]
        launch(_PROGRAM, "radix_histogram", histogram_grid, _BLOCK, arguments)
        source: Any = None
        for i in range(self.passes):
            here, there = i % 2, 1 - i % 2
            counted = histogram[i * _DIGITS :]
            state = states[i * _DIGITS * grid :]
            arguments = [keys[here], source, keys[there], values[there], on_device, number, i * digit_bits, digit_bits]
            launch(_PROGRAM, "radix_pass", grid, _BLOCK, [*arguments, counted, state, tickets[i:]])
            source = values[there]
        return keys[self.passes % 2], values[self.passes % 2]
