"""Memory of a forward and a backward pass, in a fresh process: the engine recycles that of earlier renders."""

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks import scenes
from etsplat import _native

STATUS = Path("/proc/self/status")
RESET = Path("/proc/self/clear_refs")  # Linux; elsewhere there is no peak that can be reset


def memory(name: str, threads: int, instruction_set: str) -> dict[str, float | None]:
    """MiB that a render holds besides its inputs, and by which the process grew at its peak (None: cannot tell)."""
    held, grown = in_a_process(_measure, name, threads, instruction_set)
    return {"held_mib": held, "grown_mib": grown}


def in_a_process(action: Callable[..., None], *arguments: Any) -> Any:
    """What an action sends by the connection that is its last argument, in a process of its own."""
    context = multiprocessing.get_context("spawn")
    mine, other = context.Pipe()
    process = context.Process(target=action, args=(*arguments, other))
    process.start()
    other.close()
    try:
        return mine.recv()
    finally:
        process.join()


def _measure(name: str, threads: int, instruction_set: str, answer: Connection) -> None:
    _native.set_num_threads(threads)
    _native.set_instruction_set(instruction_set)
    small = scenes.load("soup10")  # loads libraries, starts threads
    small.render().color[:, :8].sum().backward()
    scene = scenes.load(name)
    before = reset_peak() if RESET.exists() else None
    out = scene.render()
    state = out.color.grad_fn.constants[0].states[0]  # pyright: ignore[reportOptionalMemberAccess]
    out.color.backward(scene.cotangent)
    grown = None if before is None else (kibibytes("VmHWM") - before) / 1024
    outputs = [out.color, out.alpha, *(leaf.grad for leaf in scene.leaves)]
    held = state.bytes + sum(t.numel() * t.element_size() for t in outputs if t is not None)
    answer.send((held / 2**20, grown))


def reset_peak() -> int:
    """KiB that are held now, from which VmHWM begins anew."""
    RESET.write_text("5", encoding="utf-8")
    return kibibytes("VmRSS")


def kibibytes(field: str) -> int:
    line = next(line for line in STATUS.read_text(encoding="utf-8").splitlines() if line.startswith(field))
    return int(line.split()[1])
