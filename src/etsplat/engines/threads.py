"""Threads of the native engine of the CPU, and of torch beside it."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

from etsplat import _native
from etsplat.core.validation import check_count


def num_threads() -> int:
    """Number of threads the native engine uses.

    Example:
        >>> etsplat.num_threads() >= 1
        True
    """
    return _native.num_threads()


def set_num_threads(count: int) -> None:
    """Set the number of threads of the native engine; 0 means every core this process may use.

    Results do not depend on it, to the bit.

    Raises:
        ValueError: ``count`` is negative, or no whole number.

    Example:
        >>> before = etsplat.num_threads()
        >>> etsplat.set_num_threads(1)
        >>> etsplat.num_threads()
        1
        >>> etsplat.set_num_threads(before)
    """
    count = check_count("count", count, least=0)
    _native.set_num_threads(count=count)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Within the block torch computes on one thread, and leaves the others to the native engine.

    For the same bits on any number of threads: torch shares sums of a whole tensor out by it, and so does LAPACK;
    powers and sigmoids have other last bits at the ends of a thread's part, and resizing has another kernel for one.

    And for loops of small torch operations between native calls: the threads of torch's OpenMP go on spinning for
    milliseconds after each operation, on the cores where the native threads then wait. A training step of 30 ms took
    80 ms that way.
    """
    given = _given.set(_given.get() or torch.get_num_threads())
    try:
        with _torch_threads(1):
            yield
    finally:
        _given.reset(given)


@contextmanager
def all_torch_threads() -> Iterator[None]:
    """Within the block torch computes on as many threads as it did before the outermost `one_torch_thread`.

    For long work whose bits do not depend on it: sums and products of elements, convolutions, means along dimensions.
    """
    with _torch_threads(_given.get() or torch.get_num_threads()):
        yield


_given: ContextVar[int] = ContextVar("threads of torch outside of `one_torch_thread`", default=0)


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
