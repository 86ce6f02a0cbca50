"""Growth of a fresh process's resident memory over one forward and backward pass.

A process of its own, because the engine keeps the memory of earlier renders. Linux only: elsewhere there is no peak
that can be reset.
"""

import multiprocessing
from pathlib import Path

from benchmarks import scenes
from etsplat.ops.engines import set_num_threads

STATUS = Path("/proc/self/status")
RESET = Path("/proc/self/clear_refs")


def _kilobytes(field: str) -> int:
    line = next(line for line in STATUS.read_text(encoding="utf-8").splitlines() if line.startswith(field))
    return int(line.split()[1])


def _measure(name: str, threads: int, instruction_set: str, answer: "multiprocessing.SimpleQueue[float]") -> None:
    from etsplat import _native

    set_num_threads(threads)
    _native.set_instruction_set(instruction_set)
    small = scenes.load("soup10")  # loads libraries, starts threads
    small.render().color[:, :8].sum().backward()
    scene = scenes.load(name)
    RESET.write_text("5", encoding="utf-8")
    before = _kilobytes("VmRSS")
    scene.render().color.backward(scene.cotangent)
    answer.put((_kilobytes("VmHWM") - before) / 1024)


def resident_growth(name: str, threads: int, instruction_set: str) -> float | None:
    """MiB, or None where it cannot be measured."""
    if not RESET.exists():
        return None
    context = multiprocessing.get_context("spawn")
    answer = context.SimpleQueue()
    process = context.Process(target=_measure, args=(name, threads, instruction_set, answer))
    process.start()
    process.join()
    if process.exitcode != 0:
        raise RuntimeError(f"measuring the memory of {name} failed")
    return answer.get()
