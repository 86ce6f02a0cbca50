"""A sequence of launches, captured once as a CUDA graph and repeated without Python."""

from collections.abc import Callable
from typing import Any

from etsplat.engines.cuda.launch import backend


class Repeated:
    """Calls a function the first time, captures it the second time, and replays the graph from then on.

    The function must do the same on every call and read what changes from device memory; what it allocates stays
    allocated for the graph. The first call compiles kernels and fills caches, which a capture must not.
    """

    def __init__(self, body: Callable[[], None], pool: Any) -> None:
        """Captures nothing yet.

        Args:
            body: the function.
            pool: from the backend's `memory_pool`. Graphs of one pool work in the same memory: they are replayed on one
                stream, and none reads what another has left there.
        """
        self._body = body
        self._pool = pool
        self._called = False
        self._replay: Callable[[], None] | None = None

    def __call__(self) -> None:
        """Queue the launches; nothing waits for them."""
        if self._replay is not None:
            self._replay()
        elif self._called:
            self._replay = backend().capture(self._body, self._pool)
        else:
            self._body()
            self._called = True
