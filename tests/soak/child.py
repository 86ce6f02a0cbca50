"""`etsplat` in a process whose clock moves, or whose files cannot grow.

python -m tests.soak.child CLOCK BYTES ARGUMENTS...: a seed for the clock, and how far files may grow; 0 for neither.
"""

import random
import resource
import sys
import time
from collections.abc import Callable

_REAL = time.time


def moving_clock(seed: int) -> Callable[[], float]:
    """Wall-clock time that now and then jumps by up to a year, to and fro."""
    rng, offset = random.Random(seed), 0.0

    def now() -> float:
        nonlocal offset
        if rng.random() < 0.1:
            offset += rng.uniform(-1, 1) * 365 * 86400
        return max(1.0, _REAL() + offset)

    return now


def main() -> None:
    clock, size = int(sys.argv[1]), int(sys.argv[2])
    if clock:
        time.time = moving_clock(clock)
        time.time_ns = lambda: int(1e9 * time.time())
    if size:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    from etsplat.cli import main as etsplat

    sys.argv = ["etsplat", *sys.argv[3:]]
    etsplat()  # which ends the process


if __name__ == "__main__":
    main()
