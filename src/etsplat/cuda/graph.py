"""A sequence of launches, captured once as a CUDA graph and repeated without Python."""

from collections.abc import Callable
from typing import Any

import torch

from etsplat.cuda.launch import device_type


class Repeated:
    """Calls a function the first time, captures it the second time, and replays the graph from then on.

    The function must do the same on every call and read what changes from device memory; what it allocates stays
    allocated for the graph. The first call compiles kernels and fills caches, which a capture must not. Where kernels
    do not run on a GPU (the tests' backend), every call is a call.
    """

    def __init__(self, body: Callable[[], None], pool: Any) -> None:
        """Captures nothing yet.

        Args:
            body: the function.
            pool: from `memory_pool`. Graphs of one pool work in the same memory: they are replayed on one stream, and
                none reads what another has left there.
        """
        self._body = body
        self._pool = pool
        self._called = False
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Queue the launches; nothing waits for them."""
        if self._graph is None and self._called and device_type() == "cuda":
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, pool=self._pool):
                self._body()
            self._graph = graph
        if self._graph is not None:
            self._graph.replay()
        else:
            self._body()
            self._called = True


def memory_pool() -> Any:
    """What graphs allocate from."""
    return torch.cuda.graph_pool_handle() if device_type() == "cuda" else None
