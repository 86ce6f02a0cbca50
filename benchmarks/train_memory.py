"""What memory a run of `etsplat train` takes: bytes for each triangle, each photo and each pixel, beside what it says.

    python -m benchmarks.train_memory 200000 400000 800000
    python -m benchmarks.train_memory 10000000 --steps 100

Each row is a run in a process of its own, over photos of the demo's scene, with so many triangles from its first step
to its last, edits, checkpoint and result included. Peaks are the kernel's (VmHWM, Linux); "before" is what the process
held with its photos and points, and "said" is what `train` says beforehand.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

import etsplat
from benchmarks.memory import in_a_process, kibibytes
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene, demo_surface
from etsplat.data.pictures import StoredPictures
from etsplat.optim.loop import Event
from etsplat.tasks.train_checks import triangle_limit
from etsplat.tasks.train_config import TrainConfig
from etsplat.tasks.train_memory import memory_of


def capture_of(points: int, width: int, copies: int) -> Dataset:
    """The demo's scene with so many points on its surface, each photo so many times."""
    views = demo_scene(width, 3 * width // 4)
    corners, colors = demo_surface()
    generator = torch.Generator().manual_seed(0)
    face = torch.randint(len(corners), (points,), generator=generator)
    weights = -torch.rand((points, 3), generator=generator).log()
    weights /= weights.sum(dim=1, keepdim=True)
    positions = (weights[:, :, None] * corners[face]).sum(dim=1).double()
    many = [index for _ in range(copies) for index in range(len(views))]
    train = [place for place, index in enumerate(many) if index in views.train]
    return Dataset(
        viewmats=views.viewmats[many],
        Ks=views.Ks[many],
        images=StoredPictures([views.images[index].clone() for index in many]),
        names=[f"view_{place:04d}" for place in range(len(many))],
        train=train,
        test=views.test,
        exact_points=positions,
        point_colors=colors[face].clamp(0, 1),
    )


def settings(triangles: int, steps: int) -> TrainConfig:
    """Of runs in which no triangle dies, so that there are as many of them as asked for throughout."""
    changes = {
        "iterations": steps,
        "max_triangles": triangles,
        "pixels_per_triangle": None,
        "schedule.max_epochs": None,
        "sky": "none",
        "asset": False,
        "pruning.importance": 0.0,
        "pruning.opacity": 0.0,
        "output.log_every": 10,
        "output.checkpoint_every": max(1, steps // 2),
        "output.evaluate_every": max(1, steps // 2),
    }
    return TrainConfig.quick().changed(changes)


def train_once(triangles: int, width: int, copies: int, steps: int, pipe: Any) -> None:
    """One run, and its numbers through the pipe."""
    capture, config = capture_of(triangles, width, copies), settings(triangles, steps)
    capture = capture.watching(config.watch)
    said = memory_of(capture, config, triangle_limit(capture, config), torch.device("cpu"))
    before, begin = kibibytes("VmRSS"), time.process_time()
    marks: list[tuple[str, float]] = []

    def mark(event: Event) -> None:
        marks.append((type(event).__name__, kibibytes("VmHWM") / 2**20))

    with TemporaryDirectory() as place:
        result = etsplat.train(capture, Path(place) / "run", config, callbacks=[mark])
    grown = [f"{name} {gib:.2f}" for (name, gib), (_, last) in zip(marks[1:], marks, strict=False) if gib > last + 0.05]
    pipe.send(
        {
            "triangles": result.soup.count,
            "width": width,
            "photos": len(capture),
            "before": before * 1024,
            "peak": kibibytes("VmHWM") * 1024,
            "said": said.total,
            "seconds": time.process_time() - begin,
            "grown": grown,
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("triangles", nargs="+", type=int)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--width", type=int, nargs="+", default=[64])
    parser.add_argument("--copies", type=int, nargs="+", default=[1], help="of each of 42 photos")
    parser.add_argument("--debug", action="store_true", help="say after which events the peak had grown")
    options = parser.parse_args()
    print("| triangles | photos | width | before | peak | peak - before | said | processor s |\n|" + "--:|" * 8)
    for triangles in options.triangles:
        for width in options.width:
            for copies in options.copies:
                found = in_a_process(train_once, triangles, width, copies, options.steps)
                sizes = (found["before"], found["peak"], found["peak"] - found["before"], found["said"])
                numbers = [f"{size / 2**20:,.0f} MiB" for size in sizes]
                about = [f"{found['triangles']:,}", str(found["photos"]), str(width)]
                print("| " + " | ".join([*about, *numbers, f"{found['seconds']:.0f}"]) + " |", flush=True)
                if options.debug:
                    print(found["grown"], flush=True)


if __name__ == "__main__":
    main()
