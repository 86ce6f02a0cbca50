"""What a second copy of the rasterizer, beside it on the same cores, costs: forward + backward by the clock.

python -m benchmarks.contention                       sphere6 on one thread and on all cores
python -m benchmarks.contention --scene sphere4 --threads 2 --rounds 20

The copy is another process with as many threads, which draws all the time; it is halted and goes on in turn, so that
both see the same moods of the machine. Where the two have more threads than there are cores, a call takes longer by
that alone: 1.00 of a fair share is so much, and what is above it contention costs. The prototype (`prototype.py`),
where it is there, is measured beside the same copy.
"""

import argparse
import os
import signal
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console

from benchmarks import scenes
from benchmarks.machine import commit, cores, cpu_model
from benchmarks.measure import Timings, repetition, turn_milliseconds, use
from benchmarks.prototype import Prototype
from etsplat import _native

READY = "drawing"


def draw_on(scene: str, threads: int) -> None:
    """The second copy: draws until the process that started it is gone, or kills it."""
    parent = os.getppid()
    use(threads, _native.available_instruction_sets()[0])
    loaded = scenes.load(scene)
    repetition(loaded, Timings())
    print(READY, flush=True)
    while os.getppid() == parent:
        repetition(loaded, Timings())


@contextmanager
def second_copy(scene: str, threads: int) -> Iterator[subprocess.Popen[str]]:
    """A process that draws `scene`, halted."""
    command = [sys.executable, "-m", "benchmarks.contention", "--scene", scene, "--threads", str(threads), "--copy"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as copy:
        try:
            assert copy.stdout is not None
            if copy.stdout.readline().strip() != READY:
                raise RuntimeError(f"{' '.join(command)} ended before it drew anything")
            os.kill(copy.pid, signal.SIGSTOP)
            yield copy
        finally:
            copy.kill()


def quiet_and_beside(
    copy: subprocess.Popen[str], rounds: int, turns: dict[str, Callable[[], list[float]]]
) -> dict[str, tuple[float, float]]:
    """Median milliseconds of each of `turns` with the copy halted, and beside it."""
    times: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in turns}
    for _ in range(rounds):
        for beside, change in enumerate((signal.SIGSTOP, signal.SIGCONT)):
            os.kill(copy.pid, change)
            for name, turn in turns.items():
                times[name][beside].extend(turn())
    return {name: (statistics.median(quiet), statistics.median(beside)) for name, (quiet, beside) in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="sphere6", help="see benchmarks.scenes")
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, cores()}), help="default: 1, all")
    parser.add_argument("--rounds", type=int, default=12, help="turns of three repetitions, quiet and beside the copy")
    parser.add_argument("--copy", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.copy:
        draw_on(options.scene, options.threads[0])
        return
    console = Console(width=150)
    console.print(f"{cpu_model()}, {cores()} cores, commit {commit()}", highlight=False)
    scene, prototype = scenes.load(options.scene), Prototype()
    for threads in options.threads:
        use(threads, _native.available_instruction_sets()[0])
        turns: dict[str, Callable[[], list[float]]] = {"etsplat": lambda: turn_milliseconds(scene)}
        if prototype.program is not None and options.scene.startswith("sphere"):
            level = int(options.scene[6:])
            turns["prototype"] = lambda threads=threads, level=level: prototype.milliseconds(level, threads)
        fair = max(1.0, 2 * threads / cores())
        with second_copy(options.scene, threads) as copy:
            found = quiet_and_beside(copy, options.rounds, turns)
        for name, (quiet, beside) in found.items():
            console.print(
                f"{options.scene}, {threads} threads, {name}: {quiet:.1f} ms quiet, {beside:.1f} beside a second copy,"
                f" {beside / quiet / fair:.2f} of a fair share",
                highlight=False,
            )


if __name__ == "__main__":
    main()
