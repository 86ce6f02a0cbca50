"""Stable radix sort of (key, value) pairs on the device: host side of csrc/cuda/radix_sort.cu."""

import ctypes
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import constant

_PROGRAM = Program("radix_sort.cu")
_DIGITS, _BLOCK, _TILE = (constant("cuda/radix_sort.cu", name) for name in ("kDigits", "kSortBlock", "kSortTile"))
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
        # histograms, then a ticket counter and the look-back words of every pass
        histogram = zeros.data_ptr()
        ticket = histogram + 4 * self.passes * _DIGITS
        state = ticket + 4 * self.passes
        arguments = [keys[0], on_device, number, self.passes, digit_bits, ctypes.c_void_p(histogram)]
        launch(_PROGRAM, "radix_histogram", min(grid, _HISTOGRAM_GRID), _BLOCK, arguments)
        source: Any = None
        for i in range(self.passes):
            here, there = i % 2, 1 - i % 2
            words = (histogram + 4 * i * _DIGITS, state + 4 * i * _DIGITS * grid, ticket + 4 * i)
            arguments = [keys[here], source, keys[there], values[there], on_device, number, i * digit_bits, digit_bits]
            launch(_PROGRAM, "radix_pass", grid, _BLOCK, [*arguments, *map(ctypes.c_void_p, words)])
            source = values[there]
        return keys[self.passes % 2], values[self.passes % 2]
