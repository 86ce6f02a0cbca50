"""Times and counts of one scene on one instruction set and number of threads."""

import statistics
import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.machine import cores
from benchmarks.memory import memory
from benchmarks.prototype import Prototype
from benchmarks.scenes import REGISTERED, VERTEX_COLORS, Scene, load
from etsplat import _native
from etsplat.core.kernels import KERNELS

STAGES = ("project", "bin", "forward", "backward", "reduce")
SAMPLES = 3  # timed repetitions a turn, as many as the prototype makes


@dataclass
class Timings:
    """Milliseconds of every repetition."""

    forward: list[float] = field(default_factory=list)
    backward: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in STAGES})
    parallel: list[float] = field(default_factory=list)  # inside parallel_for, in the stages
    all_parallel: list[float] = field(default_factory=list)  # ... in all of the call
    processor: list[float] = field(default_factory=list)  # of all threads

    @property
    def total(self) -> list[float]:
        """Of forward and backward together."""
        return [a + b for a, b in zip(self.forward, self.backward, strict=True)]


def repetition(scene: Scene, timings: Timings) -> None:
    """A training step's rendering, from tensors to gradients."""
    for leaf in scene.leaves:
        leaf.grad = None
    before, processor = _native.parallel_seconds(), time.process_time()
    start = time.perf_counter()
    out = scene.render()
    middle = time.perf_counter()
    out.color.backward(scene.cotangent)
    end = time.perf_counter()
    timings.processor.append(1e3 * (time.process_time() - processor))
    timings.forward.append(1e3 * (middle - start))
    timings.backward.append(1e3 * (end - middle))
    timings.all_parallel.append(1e3 * (_native.parallel_seconds() - before))
    seconds = native_state(out).stage_seconds
    for name in STAGES:
        timings.stages[name].append(1e3 * seconds[name][0])
    timings.parallel.append(1e3 * sum(parallel for _, parallel in seconds.values()))


def native_state(out: Any) -> Any:
    """The native state of a render whose only image is the colour: what its autograd node keeps."""
    return out.color.grad_fn.constants[0].states[0]


def count(scene: Scene) -> dict[str, int]:
    """Work of one render."""
    state = native_state(scene.render())
    counts = _native.count_tiles(state=state)
    return {
        "pairs": state.num_pairs,
        "pairs_seen": counts.pairs,
        "forward_vectors": counts.forward_vectors,
        "backward_vectors": counts.backward_vectors,
        "useful": counts.drawn,
    }


def check_same_picture(scene: Scene, prototype: Prototype) -> float:
    """Mean difference to the prototype's picture, in levels of 255."""
    ours = (255 * scene.render().color[0].detach().clamp(0, 1)).numpy()
    difference = float(np.abs(ours - prototype.picture()).mean())
    if difference > 1.0:
        raise RuntimeError(f"{scene.name}: the prototype drew another picture, {difference:.1f} levels off on average")
    return difference


def yardstick(scene: Scene, threads: int, instruction_set: str, prototype: Prototype) -> tuple[str, Any] | None:
    """What a scene is compared with, and a call that gives the milliseconds of one turn of it."""
    for ending, plain in ((VERTEX_COLORS, "constant colours"), (REGISTERED, "the built-in kernel")):
        if scene.name.endswith(ending):
            return plain, partial(turn_milliseconds, load(scene.name.removesuffix(ending)))
    if prototype.program is not None and scene.name.startswith("sphere") and instruction_set == "avx512":
        return "prototype", lambda: prototype.milliseconds(int(scene.name[6:]), threads)
    widest = _native.available_instruction_sets()[0]
    if instruction_set != widest:
        return widest, partial(turn_on, scene, widest, instruction_set)
    return None


def one_turn(scene: Scene) -> Timings:
    """Timed repetitions after one that warms up."""
    turn = Timings()
    for warm in range(SAMPLES + 1):
        repetition(scene, turn if warm else Timings())
    return turn


def turn_milliseconds(scene: Scene) -> list[float]:
    """Of each repetition of one turn."""
    return one_turn(scene).total


def turn_on(scene: Scene, instruction_set: str, usual: str) -> list[float]:
    """The same on another instruction set than the usual one."""
    _native.set_instruction_set(instruction_set)
    try:
        return turn_milliseconds(scene)
    finally:
        _native.set_instruction_set(usual)


def measure(
    scene: Scene, threads: int, instruction_set: str, repeats: int, prototype: Prototype, with_memory: bool
) -> dict[str, Any]:
    """One entry of the JSON file."""
    other = yardstick(scene, threads, instruction_set, prototype)
    ours, turns, theirs, ratios = Timings(), [], [], []
    for _ in range(repeats):
        if other:
            theirs.append(other[1]())
        turns.append(one_turn(scene))
        if other:
            ratios.append(statistics.median(turns[-1].total) / statistics.median(theirs[-1]))
    for turn in turns:
        ours.forward += turn.forward
        ours.backward += turn.backward
        ours.parallel += turn.parallel
        ours.all_parallel += turn.all_parallel
        ours.processor += turn.processor
        for name in STAGES:
            ours.stages[name] += turn.stages[name]
    entry: dict[str, Any] = {
        "scene": scene.name,
        "triangles": len(scene.opacities),
        "instruction_set": instruction_set,
        "threads": threads,
        "milliseconds": summary(ours.total),
        "processor": summary(ours.processor),
        "forward": summary(ours.forward),
        "backward": summary(ours.backward),
        "stages": {name: summary(values) for name, values in ours.stages.items()},
    }
    if other:
        flat = [value for values in theirs for value in values]
        ratio = entry["milliseconds"]["median"] / statistics.median(flat)
        entry["yardstick"] = {"name": other[0], **summary(flat)}
        entry["ratio"] = {"median": ratio, "low": min(ratios), "high": max(ratios)}
        if other[0] == "prototype":
            entry["picture_difference"] = check_same_picture(scene, prototype)
    derive(entry, ours, count(scene), min(threads, cores()))
    if with_memory:
        entry["memory"] = memory(scene.name, threads, instruction_set)
    return entry


def summary(values: list[float]) -> dict[str, float]:
    ordered = sorted(values)
    quarter = len(ordered) // 4
    return {
        "median": statistics.median(ordered),
        "best": ordered[0],
        "low": ordered[quarter],
        "high": ordered[-1 - quarter],
        "runs": len(ordered),
    }


def derive(entry: dict[str, Any], timings: Timings, counts: dict[str, int], workers: int) -> None:
    """What follows from times and counts. The scene is one of the elastic kernel."""
    kernel = _native.time_kernel(kernel=KERNELS["elastic"].native_id, sigma=0.5)
    stage = {name: entry["stages"][name]["median"] for name in STAGES}
    native = [sum(values) for values in zip(*timings.stages.values(), strict=True)]
    entry["counts"] = counts
    entry["kernel_nanoseconds"] = {"value": kernel.value, "gradient": kernel.gradient}
    entry["outside_stages"] = statistics.median(t - n for n, t in zip(native, timings.total, strict=True))
    # On a busy machine a whole call of one thread is interrupted, what lies outside of parallel_for hardly ever.
    whole = [entry["processor"]["median"]] * len(native) if entry["threads"] == 1 else timings.total
    entry["serial"] = {
        "stages": statistics.median((n - p) / t for n, p, t in zip(native, timings.parallel, whole, strict=True)),
        "all": statistics.median(
            (t - p) / w for t, p, w in zip(timings.total, timings.all_parallel, whole, strict=True)
        ),
    }
    useful = max(1, counts["useful"])
    entry["nanoseconds_per_useful_pair"] = 1e6 * entry["milliseconds"]["median"] / useful
    entry["lane_utilisation"] = {
        name: useful / max(1, 16 * counts[f"{name}_vectors"]) for name in ("forward", "backward")
    }
    floor = {
        "forward": 1e-6 * counts["forward_vectors"] * kernel.value / workers,
        "backward": 1e-6 * counts["backward_vectors"] * kernel.gradient / workers,
    }
    entry["kernel_share"] = {name: floor[name] / stage[name] for name in floor}


def use(threads: int, instruction_set: str) -> None:
    torch.set_num_threads(threads)
    _native.set_num_threads(threads)
    _native.set_instruction_set(instruction_set)
