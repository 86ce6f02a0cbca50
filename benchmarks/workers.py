"""What a step of several workers sends, and a model of how long it takes on networks of a stated speed.

python -m benchmarks.workers --triangles 50000 --width 640
python -m benchmarks.workers data/scenes/kitchen25 --triangles 100000 --width 800 --cores 16

    python -m benchmarks.workers --check --triangles 20000 --width 320

Bytes are counted. Compute is measured on one core, in seconds of this process, which other processes disturb less than
those of the clock. The rest is a model, not a measurement:

    step = share (view / cores + pack) + B (unpack + add + colors / cores) + parameters + Adam
         + (B - share) bytes / network + (B + share + 1) hops latency

with B views, share = ceil(B / workers) and hops = ceil(log2(workers)): drawing, and what leads from colours to
coefficients, have as many cores as a worker has, all else one. A step has a broadcast for each view, and gatherings of
small numbers, one for each view of a worker and one more. One process neither packs nor unpacks. Messages, all but the
last of each worker, travel while its next view is drawn: of their time so much is taken off again as drawing takes.

Last it answers when one worker for each of a machine's nodes of memory (NUMA) is better than one process on all cores:
by how many times memory of other nodes would have to slow drawing down there, for both to take as long. Messages
between workers cost their packing alone, which is in favour of workers.

With --check steps are made by one process and by two, and the processor's time of a step, and the bytes, are compared
with what the model says of them. What sending while the next view is drawn gives is seen by the clock, on a network as
slow as one says, of which both directions go through the same loopback (Linux):

    unshare -rn sh -c "ip link set lo up && tc qdisc add dev lo root tbf rate 400mbit burst 256kb latency 1s &&
        python -m benchmarks.workers --check --triangles 20000 --width 320 --views 4"
"""

import argparse
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from benchmarks.machine import description
from etsplat.core.workers import Workers, together
from etsplat.core.workers import workers as present
from etsplat.data.demo_scene import demo_scene
from etsplat.data.load import load_dataset
from etsplat.engines.threads import one_torch_thread, set_num_threads
from etsplat.ops.soup_colors import EndAtColors, colors_backward
from etsplat.optim import shared_steps
from etsplat.optim.trainer import Trainer
from etsplat.tasks.soup_trainer import start_trainer
from etsplat.tasks.train_config import TrainConfig

STEPS, ROUNDS = 4, 15
"""Of a check: steps that are measured, and how often messages are handed round."""

WORKERS = (1, 2, 4, 8, 16, 32, 64)
NETWORKS = (1, 10, 100)
"""Gbit/s."""

NODES = ((2, 2), (2, 8), (4, 4), (4, 16))
"""Of memory on one machine, and views of a step, of a question that is asked of the model."""

LATENCY = 50e-6
"""Seconds of a hop of a message, a stated number as the networks' are."""


@dataclass(frozen=True)
class Traffic:
    """What a step of several workers takes of a network.

    Attributes:
        broadcasts: of a view's message each, by its worker to all others.
        gatherings: of a few numbers of all: how long messages are, for each view of a worker, and whether one was
            interrupted.
        received: messages that the worker receives which draws most.
        hops: of a broadcast, from one worker to others and from these on.
    """

    broadcasts: int
    gatherings: int
    received: int
    hops: int

    @staticmethod
    def of(views: int, workers: int) -> "Traffic":
        """Of so many views; nothing of one worker."""
        if workers == 1:
            return Traffic(0, 0, 0, 0)
        share = math.ceil(views / workers)
        return Traffic(views, share + 1, views - share, math.ceil(math.log2(workers)))

    @property
    def calls(self) -> int:
        """All of them."""
        return self.broadcasts + self.gatherings


def seconds(action: Callable[[], object], repeats: int) -> float:
    """Of this process, on average."""
    start = time.process_time()
    for _ in range(repeats):
        action()
    return (time.process_time() - start) / repeats


class Recorder(Workers):
    """The first of two workers, without the other: its own messages in the place of all."""

    def __init__(self) -> None:
        super().__init__(0, 2)
        self.message = torch.empty(0, dtype=torch.uint8)

    def hand_round(self, make: Callable[[int], Tensor], owners: Sequence[int]) -> Iterator[Tensor]:
        """Its own, each time."""
        self.message = make(0)
        return iter([self.message] * len(owners))


def message_of(trainer: Trainer[Any], iteration: int) -> Tensor:
    """What a view of a step sends: that of a step of two views, in which only the first is drawn."""
    recorder, honest, stepper = Recorder(), shared_steps.owners, trainer._stepper
    weights = stepper._objective.weights(iteration)
    alone = partial(stepper._of_parameters, weights, 1.0, decayed=True)
    apart = shared_steps.Apart(trainer.model.COLORED, alone)
    shared_steps.owners = lambda views, count: [0, 1]
    try:
        draw = drawing(trainer, iteration)
        shared_steps.shared_gradients(recorder, [0, 1], draw, [trainer.adam], trainer.strategy.outputs, apart)
    finally:
        shared_steps.owners = honest
    return recorder.message


def drawing(trainer: Trainer[Any], iteration: int) -> shared_steps.Gradients:
    """Of the next view."""
    stepper = trainer._stepper
    chosen, weights = stepper._choose(iteration)[0], stepper._objective.weights(iteration)
    views = [(stepper._loader.view(chosen.view), chosen.background)]
    options = {"moving": False, "separate": True, "decayed": True}
    return lambda places: stepper._gradients(views, weights, 1.0, first=places.start, **options)


def drawn(trainer: Trainer[Any], iteration: int) -> None:
    """The next view, and its gradients up to the colours of triangles."""
    with EndAtColors(*(getattr(trainer.model, name) for name in trainer.model.COLORED)):
        drawing(trainer, iteration)(range(1))


def measure(trainer: Trainer[Any], config: TrainConfig) -> dict[str, float]:
    """Seconds of a core and bytes, each of one view; those of parameters and Adam of a step."""
    iteration, model, stepper = config.iterations, trainer.model, trainer._stepper
    weights = stepper._objective.weights(iteration)
    stepper.arrive(iteration)
    messages = [message_of(trainer, iteration) for _ in range(4)]
    tensors = shared_steps.unpack(messages[0])
    gradients = [tensor for name, tensor in tensors.items() if name.startswith("gradient.")]
    sums, colored = [gradient.clone() for gradient in gradients], [getattr(model, name) for name in model.COLORED]
    by_colors = partial(colors_backward, tensors["colors"][None], *colored, tensors["center"], int(tensors["degree"]))
    more = [torch.zeros_like(tensor) for tensor in by_colors()]
    sums, gradients = [*sums, *more], [*gradients, *by_colors()]
    cost = {
        "view": seconds(partial(drawn, trainer, iteration), 4),
        "colors": seconds(by_colors, 5),
        "pack": seconds(lambda: shared_steps.pack(tensors), 5),
        "unpack": seconds(lambda: shared_steps.unpack(messages[0]), 5),
        "add": seconds(lambda: [total.add_(each) for total, each in zip(sums, gradients, strict=True)], 5),
        "parameters": seconds(partial(stepper._of_parameters, weights, 1.0, decayed=True), 5),
        "bytes": sum(map(len, messages)) / len(messages),
        "shown": float(tensors["seen.statistics.visible"].float().mean()),
    }
    for parameter in trainer.adam.parameters.values():
        parameter.grad = torch.zeros_like(parameter)
    step = partial(trainer.adam.step, stepper._objective.decays(model, weights, 1.0))
    return {**cost, "adam": seconds(step, 5)}


def computed(found: Mapping[str, float], views: int, workers: int, cores: int) -> float:
    """Seconds of a step in which a worker computes."""
    share = math.ceil(views / workers)
    once = found["parameters"] + found["adam"]
    if workers == 1:
        return views * ((found["view"] + found["colors"]) / cores + found["add"]) + once
    each = found["unpack"] + found["add"] + found["colors"] / cores
    return share * (found["view"] / cores + found["pack"]) + views * each + once


def modelled(
    found: Mapping[str, float], views: int, workers: int, cores: int, gigabits: float, *, late: bool = False
) -> float:
    """Seconds of a step; where messages are `late` they travel only when all views are drawn."""
    traffic, share = Traffic.of(views, workers), math.ceil(views / workers)
    sending = traffic.received * found["bytes"] * 8 / (gigabits * 1e9) + traffic.calls * traffic.hops * LATENCY
    whole, drawn = computed(found, views, workers, cores) + sending, share * found["view"] / cores
    return whole if late else whole - min(sending, drawn) * (share - 1) / share


def break_even(found: Mapping[str, float], views: int, nodes: int, cores: int) -> float:
    """How much slower one process on all nodes must draw, for a worker on the cores of each node to be as fast."""
    apart = computed(found, views, nodes, cores)
    whole = computed(found, views, 1, nodes * cores)
    return 1 + (apart - whole) * nodes * cores / (views * found["view"])


def steps_of(rank: int, count: int, arguments: argparse.Namespace, place: str, pipe: Any) -> None:
    """In one of so many processes: processor seconds of a step, after a first that warms up, and what it handed on."""
    set_num_threads(1)
    trainer, config = start(arguments)
    with one_torch_thread(), together(place, rank=rank, count=count):
        first, group = config.iterations - STEPS, present()
        trainer._stepper.advance(first, first, ())
        start_time, before = time.process_time(), dict(group.sent)
        for iteration in range(first + 1, config.iterations + 1):
            trainer._stepper.advance(iteration, iteration, ())
        sent = {name: (group.sent[name] - before[name]) / STEPS for name in before}
        pipe.send({"seconds": (time.process_time() - start_time) / STEPS, **sent})


def handed_round(rank: int, late: bool, found: Mapping[str, float], place: str, pipe: Any) -> None:
    """In one of two processes: seconds by the clock in which both hand round two messages each, the median.

    Views are drawn asleep, so that nothing else on the machine disturbs it. `late` messages travel only when all are
    made.
    """
    message = torch.zeros(int(found["bytes"]), dtype=torch.uint8)

    def make(number: int) -> Tensor:
        time.sleep(found["view"])
        return message

    took = []
    with together(place, rank=rank, count=2) as group:
        for _ in range(ROUNDS):
            begin = time.perf_counter()
            made = {number: make(number) for number in (rank, rank + 2)} if late else None
            for each in group.hand_round(make if made is None else made.__getitem__, [0, 1, 0, 1]):
                assert len(each) == len(message)
            took.append(time.perf_counter() - begin)
    pipe.send(sorted(took)[ROUNDS // 2])


def check(arguments: argparse.Namespace, found: Mapping[str, float]) -> None:
    """Compares the model with steps of one process and of two."""
    views = arguments.views
    print("\n| processes | ms of a core in a step | model | messages | model | MB handed on | model |")
    print("| --: |" + " --: |" * 6)
    for count in (1, 2):
        each = in_processes(steps_of, count, count, arguments)
        took, traffic = 1000 * sum(one["seconds"] for one in each) / count, Traffic.of(views, count)
        messages, megabytes = (sum(one[name] for one in each) for name in ("messages", "bytes"))
        said = 1000 * computed(found, views, count, 1), traffic.broadcasts, traffic.broadcasts * found["bytes"] / 1e6
        print(f"| {count} | {took:.0f} | {said[0]:.0f} | {messages:.1f} | {said[1]} ", end="")
        print(f"| {megabytes / 1e6:.2f} | {said[2]:.2f} |", flush=True)
    early, late = (1000 * max(in_processes(handed_round, 2, late, found)) for late in (False, True))
    print(f"\nTwo processes, two views each, asleep while they are drawn: {early:.0f} ms; sent late {late:.0f} ms")


def in_processes(what: Callable[..., None], count: int, *arguments: Any) -> list[Any]:
    """What a function sends in each of so many processes, which get their rank, these arguments and where they meet."""
    context = multiprocessing.get_context("spawn")
    with TemporaryDirectory() as folder:
        pipes = [context.Pipe() for _ in range(count)]
        place = f"file://{folder}/meeting"
        processes = [
            context.Process(target=what, args=(rank, *arguments, place, there)) for rank, (_, there) in enumerate(pipes)
        ]
        for process in processes:
            process.start()
        each = [here.recv() for here, _ in pipes]
        for process in processes:
            process.join()
    return each


def start(arguments: argparse.Namespace) -> tuple[Trainer[Any], TrainConfig]:
    """A run with random triangles, as many as asked."""
    width = arguments.width
    capture = load_dataset(arguments.scene, width=width) if arguments.scene else demo_scene(width, width * 3 // 4)
    config = TrainConfig.of("quick", "outdoor").changed({"start.points": arguments.triangles, "batch": arguments.views})
    with one_torch_thread():
        return start_trainer(replace(capture.normalized(), exact_points=None, point_colors=None), config), config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", type=Path, help="a folder with posed photos; the demo's scene without")
    parser.add_argument("--triangles", type=int, default=50_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--cores", type=int, default=8, help="of each worker, in the model")
    parser.add_argument("--check", action="store_true", help="compare with one process and two")
    parser.add_argument("--views", type=int, default=2, help="of a step of a check")
    parser.add_argument("--draw", type=int, metavar="VIEWS", help="only draw, for tools that count")
    arguments = parser.parse_args()
    set_num_threads(1)
    trainer, config = start(arguments)
    with one_torch_thread():
        if arguments.draw is not None:
            trainer._stepper.arrive(config.iterations)
            for _ in range(arguments.draw):
                drawn(trainer, config.iterations)
            return
        found = measure(trainer, config)
    print(description())
    count, (width, height) = trainer.count, trainer._dataset.images.sizes[0]
    print(f"{count:,} triangles, {width} x {height}: of one view {found['bytes'] / 1e6:.2f} MB are sent, ", end="")
    print(f"{found['bytes'] / count:.0f} bytes per triangle")
    names = ("view", "colors", "pack", "unpack", "add", "parameters", "adam")
    print("ms of one core: " + ", ".join(f"{name} {1000 * found[name]:.1f}" for name in names))
    print(f"a view shows {found['shown']:.0%} of them")
    if arguments.check:
        check(arguments, found)
        return
    for each in (1, 4):
        print(f"\nModel: views per second, {each} of each worker in a step, {arguments.cores} cores each")
        print("(in parentheses: were messages to travel only when all are drawn)\n")
        print("| workers | " + " | ".join(f"{speed} Gbit/s" for speed in NETWORKS) + " |")
        print("| --: |" + " --: |" * len(NETWORKS))
        for workers in WORKERS:
            views, about = each * workers, (found, each * workers, workers, arguments.cores)
            rates = [[views / modelled(*about, speed, late=late) for late in (False, True)] for speed in NETWORKS]
            print(f"| {workers} | " + " | ".join(f"{one:.1f} ({other:.1f})" for one, other in rates) + " |")
    print("\nModel: how many times slower one process on all nodes must draw, for one worker on each to be as fast\n")
    print("| cores of a node | " + " | ".join(f"{nodes} nodes, {views} views" for nodes, views in NODES) + " |")
    print("| --: |" + " --: |" * len(NODES))
    for cores in (4, 8, 16, 32, 64):
        times = [break_even(found, views, nodes, cores) for nodes, views in NODES]
        print(f"| {cores} | " + " | ".join(f"{each:.2f}" for each in times) + " |")


if __name__ == "__main__":
    main()
