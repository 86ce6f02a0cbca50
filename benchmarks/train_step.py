"""Milliseconds of a training step of novel-view synthesis, the rasterizer's share, and that of each other part.

python -m benchmarks.train_step data/scenes/kitchen25 --triangles 100000 --width 800
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.machine import description
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.load import load_dataset
from etsplat.engines.threads import num_threads, one_torch_thread, set_num_threads
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.photometric import photometric_loss
from etsplat.ops.rasterize import rasterize
from etsplat.ops.soup_colors import soup_colors
from etsplat.optim.strategies import DensifyAndPrune
from etsplat.optim.trainer import Trainer
from etsplat.tasks.soup_trainer import start_trainer
from etsplat.tasks.train_config import TrainConfig

WARM_UP = 60
"""Steps before anything is timed: the soup is then no longer the start."""


def grown(capture: Dataset, config: TrainConfig) -> Trainer[TriangleSoup]:
    """A soup of `config.max_triangles` triangles that has taken some steps at its full degree."""
    trainer = start_trainer(capture, config)
    strategy = trainer.strategy
    assert isinstance(strategy, DensifyAndPrune)
    iteration = 0
    while trainer.count < config.max_triangles or iteration < WARM_UP:
        iteration += 1
        trainer.advance(iteration, iteration)
        if iteration % 5 == 0:
            strategy.densify(iteration)
    return trainer


def median_ms(action: Callable[[], object], repeats: int) -> float:
    """The median, which on a machine that does other things as well is far above what the action takes alone."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return 1000 * statistics.median(times)


def measure(trainer: Trainer[TriangleSoup], capture: Dataset, config: TrainConfig, repeats: int) -> dict[str, float]:
    """Means over all training views of step and rasterizer, which can then be subtracted; of the parts, on one view."""
    first = config.iterations - 3 * len(capture.train)
    start = time.perf_counter()
    for iteration in range(first, first + 2 * len(capture.train)):
        trainer.advance(iteration, iteration)
    step = 1000 * (time.perf_counter() - start) / (2 * len(capture.train))
    rasterizer = statistics.mean(median_ms(rasterizing(trainer, capture, config, view), 3) for view in capture.train)
    view = capture.train[0]
    return {
        "step": step,
        "rasterizer": rasterizer,
        "outside": step - rasterizer,
        "colours": median_ms(coloring(trainer, capture, view), repeats),
        "photometric loss": median_ms(comparing(capture, view), repeats),
        "Adam": median_ms(trainer.adam.step, repeats),
    }


def rasterizing(
    trainer: Trainer[TriangleSoup], capture: Dataset, config: TrainConfig, view: int
) -> Callable[[], object]:
    camera, soup = capture.cameras[view], trainer.model
    with torch.no_grad():
        colors = soup_colors(soup.vertices, soup.sh_dc, soup.sh_rest, camera.centers, soup.sh_degree)
    leaves = [t.detach().clone().requires_grad_() for t in (soup.vertices, colors, soup.opacities, soup.sigma)]
    vertices, face_colors, opacities, sigma = leaves
    cotangent = torch.rand(1, camera.height, camera.width, 3)

    def run() -> None:
        for leaf in leaves:
            leaf.grad = None
        out = rasterize(
            vertices,
            opacities=opacities,
            sigma=sigma,
            face_colors=face_colors,
            cameras=camera,
            kernel=config.kernel,
            distance=config.distance,
            backgrounds=torch.zeros(1, 3),
            near_plane=config.drawing.near_plane,
            outputs=("statistics",),
            validate=False,
        )
        out.color.backward(cotangent)

    return run


def coloring(trainer: Trainer[TriangleSoup], capture: Dataset, view: int) -> Callable[[], object]:
    soup, centers = trainer.model, capture.cameras[view].centers
    cotangent = torch.rand(1, len(soup), 3)

    def run() -> None:
        for parameter in (soup.vertices, soup.sh_dc, soup.sh_rest):
            parameter.grad = None
        soup_colors(soup.vertices, soup.sh_dc, soup.sh_rest, centers, soup.sh_degree).backward(cotangent)

    return run


def comparing(capture: Dataset, view: int) -> Callable[[], object]:
    target = capture.images[view][None]
    color = torch.rand((*target.shape[:3], 3)).requires_grad_()

    def run() -> None:
        color.grad = None
        photometric_loss(color, target, 0.2).backward()

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?", help="a capture; the built-in scene without one")
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--method", default="elastic")
    parser.add_argument("--scene-type", default="outdoor")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", type=Path, help="write the result here as well")
    options = parser.parse_args()
    set_num_threads(options.threads)
    loaded = load_dataset(options.scene, width=options.width) if options.scene else demo_scene(options.width)
    config = TrainConfig.of(options.preset, options.scene_type).changed(
        {
            "method": options.method,
            "max_triangles": options.triangles,
            "iterations": 100_000,
            "schedule.sh_every": 1,
        }
    )
    if config.loss.lambda_depth_normal > 0:
        config = config.changed({"loss.regularize_from": 0})
    capture = loaded.normalized() if config.normalize else loaded
    with one_torch_thread():
        trainer = grown(capture, config)
        times = measure(trainer, capture, config, options.repeats)
    size = capture.images.sizes[0]
    print(f"{trainer.count:,} triangles, {size[0]}x{size[1]}, {options.method}, {num_threads()} threads")
    for name, value in times.items():
        print(f"  {name:18} {value:7.1f} ms")
    if options.json:
        result: dict[str, Any] = {"triangles": trainer.count, "size": size, "threads": num_threads(), **times}
        options.json.write_text(json.dumps({**description(), **result}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
