"""What a step of several workers sends, and a model of how long it takes on networks of a stated speed.

python -m benchmarks.workers --triangles 50000 --width 640
python -m benchmarks.workers ../shared/data/scenes/kitchen25 --triangles 100000 --width 800 --cores 16

Bytes are counted. Compute is measured on one core, in seconds of this process, which other processes disturb less than
those of the clock. The rest is a model, not a measurement:

    step = share * view / cores + B * (unpack + add) + pack * share + Adam + (B - share) * bytes / network

with B views and share = ceil(B / workers): drawing has as many cores as a worker has, all else one.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.machine import description
from etsplat.core.rasterization import Rasterization
from etsplat.core.workers import Workers
from etsplat.data.demo_scene import demo_scene
from etsplat.data.load import load_dataset
from etsplat.engines.threads import one_torch_thread, set_num_threads
from etsplat.optim import shared_steps
from etsplat.optim.trainer import Trainer
from etsplat.tasks.soup_trainer import start_trainer
from etsplat.tasks.train_config import TrainConfig

WORKERS = (1, 2, 4, 8, 16, 32, 64)
NETWORKS = (1, 10, 100)
"""Gbit/s."""


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

    def hand_round(self, own: Mapping[int, Tensor], owners: Sequence[int]) -> Iterator[Tensor]:
        """Its own, each time."""
        self.message = next(iter(own.values()))
        return iter([self.message] * len(owners))


def message_of(trainer: Trainer[Any], iteration: int) -> Tensor:
    """What a view of a step sends: that of a step of two views, in which only the first is drawn.

    Terms of parameters alone, which travel with the last view, are not in it.
    """
    recorder, honest = Recorder(), shared_steps.owners
    stepper = trainer._stepper
    chosen = stepper._choose()[0]
    view, background = stepper._loader.view(chosen.view), chosen.background
    weights = stepper._objective.weights(iteration)

    def gradients(places: range) -> tuple[Tensor, list[Rasterization]]:
        return stepper._gradients([(view, background)], weights, 1.0, first=places.start)

    shared_steps.owners = lambda views, count: [0, 1]
    try:
        shared_steps.shared_gradients(recorder, [0, 1], gradients, [trainer.adam], trainer.strategy.outputs)
    finally:
        shared_steps.owners = honest
    return recorder.message


def measure(trainer: Trainer[Any], config: TrainConfig) -> dict[str, float]:
    """Seconds of a core and bytes, each of one view; Adam's of a step."""
    iteration = config.iterations
    trainer._stepper.arrive(iteration)
    messages = [message_of(trainer, iteration) for _ in range(4)]
    tensors = shared_steps.unpack(messages[0])
    gradients = [tensor for name, tensor in tensors.items() if name.startswith("gradient.")]
    sums = [gradient.clone() for gradient in gradients]
    return {
        "view": seconds(lambda: message_of(trainer, iteration), 4),
        "pack": seconds(lambda: shared_steps.pack(tensors), 5),
        "unpack": seconds(lambda: shared_steps.unpack(messages[0]), 5),
        "add": seconds(lambda: [total.add_(each) for total, each in zip(sums, gradients, strict=True)], 5),
        "adam": seconds(trainer.adam.step, 5),
        "bytes": sum(map(len, messages)) / len(messages),
        "dense": sum(tensor.numel() * tensor.element_size() for tensor in tensors.values()),
    }


def modelled(found: dict[str, float], views: int, workers: int, cores: int, gigabits: float) -> float:
    """Seconds of a step."""
    share = math.ceil(views / workers)
    drawing = max(0.0, found["view"] - found["pack"] - 2 * (found["unpack"] + found["add"]))
    shared = views * (found["unpack"] + found["add"]) + share * found["pack"] if workers > 1 else 0.0
    sending = (views - share) * found["bytes"] * 8 / (gigabits * 1e9) if workers > 1 else 0.0
    return share * drawing / cores + shared + found["adam"] + sending


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", type=Path, help="a folder with posed photos; the demo's scene without")
    parser.add_argument("--triangles", type=int, default=50_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--cores", type=int, default=8, help="of each worker, in the model")
    arguments = parser.parse_args()
    set_num_threads(1)
    width = arguments.width
    capture = load_dataset(arguments.scene, width=width) if arguments.scene else demo_scene(width, width * 3 // 4)
    config = TrainConfig.of("quick", "outdoor").changed({"start.points": arguments.triangles, "batch": 2})
    capture = replace(capture.normalized(), exact_points=None, point_colors=None)  # random triangles, as many as asked
    with one_torch_thread():
        trainer = start_trainer(capture, config)
        found = measure(trainer, config)
    print(description())
    count, (width, height) = trainer.count, capture.images.sizes[0]
    print(f"{count:,} triangles, {width} x {height}: of one view {found['bytes'] / 1e6:.2f} MB are sent, ", end="")
    print(f"{found['bytes'] / count:.0f} bytes per triangle; without leaving out rows {found['dense'] / count:.0f}")
    names = ("view", "pack", "unpack", "add", "adam")
    print("ms of one core: " + ", ".join(f"{name} {1000 * found[name]:.1f}" for name in names))
    for each in (1, 4):
        print(f"\nModel: views per second, {each} of each worker in a step, {arguments.cores} cores each\n")
        print("| workers | " + " | ".join(f"{speed} Gbit/s" for speed in NETWORKS) + " |")
        print("| --: |" + " --: |" * len(NETWORKS))
        for workers in WORKERS:
            views = each * workers
            rates = [views / modelled(found, views, workers, arguments.cores, speed) for speed in NETWORKS]
            print(f"| {workers} | " + " | ".join(f"{rate:.1f}" for rate in rates) + " |")


if __name__ == "__main__":
    main()
