"""The same on several numbers of torch's threads."""

from collections.abc import Callable
from typing import TypeVar

import torch

Result = TypeVar("Result")

COUNTS = (1, 2, 3, 5)


def on_each_count(compute: Callable[[], Result]) -> list[Result]:
    """What is computed on each of `COUNTS` threads of torch, whose number is put back afterwards."""
    before, results = torch.get_num_threads(), []
    try:
        for count in COUNTS:
            torch.set_num_threads(count)
            results.append(compute())
            assert torch.get_num_threads() == count, "the number of threads was not put back"
    finally:
        torch.set_num_threads(before)
    return results
