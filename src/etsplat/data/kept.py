"""What is made of photos is made once while a start is made, whose parts look at the same ones, and then given away."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_kept: ContextVar[dict[Any, Any] | None] = ContextVar("kept", default=None)


@contextmanager
def keeping() -> Iterator[None]:
    """Until its end what functions that are `kept` return is kept."""
    token = _kept.set({})
    try:
        yield
    finally:
        _kept.reset(token)


def kept(function: Callable[P, T]) -> Callable[P, T]:
    """The function, which returns what it has returned while `keeping`, to the same data set and equal other arguments.

    What it returns is not to be changed.
    """

    @functools.wraps(function)
    def call(*args: P.args, **known: P.kwargs) -> T:
        found = _kept.get()
        if found is None:
            return function(*args, **known)
        key = (function, args, tuple(known.items()))
        if key not in found:
            found[key] = function(*args, **known)
        return found[key]

    return call
