"""A bound on memory within a block: what goes beyond it is a ``MemoryError``, not a machine that swaps."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest


@contextlib.contextmanager
def room_for(mebibytes: int) -> Iterator[None]:
    """Within the block the process may map so much more than it has mapped."""
    resource = pytest.importorskip("resource")
    status = Path("/proc/self/statm")
    if not status.is_file():
        pytest.skip("the memory that the process has mapped is not known on this system")
    mapped = int(status.read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (mebibytes << 20), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
