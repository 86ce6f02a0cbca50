"""Stable radix sort of (key, value) pairs on the device, and running sums: host side of sort.wgsl and scan.wgsl."""

import math
from typing import Any

import numpy as np

from etsplat.engines.webgpu.device import Part, Program, Step, WebGpu, spread

_SORT = Program(("common", "block_scan", "sort"))
_SCAN = Program(("block_scan", "scan"))
_DIGIT_BITS, _BLOCK = 4, 2048
_SLICE = 256  # bytes: where a part of a uniform buffer may begin, everywhere


def scan_step(gpu: WebGpu, name: str, sums: Any, count: int) -> Step:
    """Each of `count` numbers becomes the sum of those before it; the sum of all is written behind them."""
    numbers = gpu.filled(name, np.array([0, 0, 0, count], np.uint32))
    return Step(_SCAN, "scan", (1, 1), {"step": Part(numbers, 0, 16), "sums": sums})


def sort_steps(
    gpu: WebGpu, name: str, keys: tuple[Any, Any], values: tuple[Any, Any], count: int, bits: int
) -> tuple[list[Step], Any, Any]:
    """Sort `count` pairs by the low bits of their keys.

    Args:
        gpu: the device.
        name: by which the buffers of this sort are kept.
        keys: two buffers; what is to be sorted is in the first. Both are overwritten, as are those of the values.
        values: two buffers.
        count: of the pairs, at least one.
        bits: keys are below 2 to the power of these.

    Returns:
        The steps, and the buffers that hold sorted keys and values after them.
    """
    blocks, passes = math.ceil(count / _BLOCK), max(1, math.ceil(bits / _DIGIT_BITS))
    numbers = np.zeros((passes, _SLICE // 4), np.uint32)
    numbers[:, :4] = [(_DIGIT_BITS * i, count, blocks, 16 * blocks) for i in range(passes)]
    told = gpu.filled(f"{name} steps", numbers)
    starts = gpu.room(f"{name} starts", 4 * (16 * blocks + 1))
    groups, steps = spread(blocks), []
    for i in range(passes):
        here, there = i % 2, 1 - i % 2
        part = Part(told, _SLICE * i, 16)
        read = {"step": part, "keys": keys[here], "starts": starts}
        written = {"values": values[here], "sorted_keys": keys[there], "sorted_values": values[there]}
        steps.append(Step(_SORT, "count_digits", groups, read))
        steps.append(Step(_SCAN, "scan", (1, 1), {"step": part, "sums": starts}))
        steps.append(Step(_SORT, "scatter", groups, {**read, **written}))
    return steps, keys[passes % 2], values[passes % 2]
