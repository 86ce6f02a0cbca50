"""A scene in blocks against one run of the same budget: quality, seams, and memory.

    python -m benchmarks.blocks --steps 1000 --triangles 4000 --seeds 0 1 2
    python -m benchmarks.blocks --memory 1600000

The scene is made in code: eight of the demo's tables, in fewer faces, on a painted ground, 288 photos around them. The
run in blocks comes first. The one beside it has as many steps as the coarse run, all blocks and the sky together, and
as many triangles as their result. A pixel of a test photo belongs to the sky, or to the seams where the true surface is
within a tenth of a block's width of a border between blocks, to the middle where it is farther than a quarter, or
between.

With --memory, nothing is compared: so many points, a few steps; how much each process grows beyond what it held with
photos and points (VmHWM, Linux), of one run, and of each run of the same in blocks.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import etsplat
from benchmarks.memory import in_a_process, kibibytes, reset_peak
from etsplat.core.cameras import Cameras, intrinsics, look_at, sphere_grid
from etsplat.data.blocks import Grid, cut
from etsplat.data.dataset import Dataset, every_eighth
from etsplat.data.demo_scene import demo_photo, demo_surface
from etsplat.data.pictures import StoredPictures, as_float
from etsplat.data.where_up import up_of
from etsplat.engines.threads import one_torch_thread
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.optim.loop import Event, NoteEvent, StageEvent
from etsplat.tasks.train_config import TrainConfig

TABLES, APART = (4, 2), 3.9
RING = 36
"""Photos around each table."""

LATTICE = 0.05
BORDER, MIDDLE = 0.1, 0.25
_SKY = 20480
"""Faces of the demo's sky, the last of its surface."""


def surface() -> tuple[Float[Tensor, "F 3 3"], Float[Tensor, "F 3"], int]:
    """Corners and colours of all faces, and how many of them are not sky."""
    corners, colors = demo_surface()
    table, paint = _coarser(corners[:-_SKY], colors[:-_SKY])
    parts, paints = [], []
    for number, place in enumerate(_places()):
        angle = torch.tensor(0.7 * number)
        c, s, one, zero = angle.cos(), angle.sin(), torch.tensor(1.0), torch.tensor(0.0)
        turn = torch.stack([c, zero, s, zero, one, zero, -s, zero, c]).view(3, 3)
        parts.append(table @ turn.T + place)
        mixed = paint.roll(number % 3, dims=1).clamp(0, 1)
        paints.append(0.5 * paint.clamp(0, 1) + 0.5 * mixed)
    ground, floor = _ground()
    sky = corners[-_SKY:] * 3
    everything = torch.cat([*parts, ground, sky]), torch.cat([*paints, floor, colors[-_SKY:]])
    return *everything, len(everything[0]) - _SKY


def capture(width: int, points: int) -> Dataset:
    """Photos of it, every eighth for testing."""
    corners, colors, things = surface()
    up = torch.tensor([0.0, 1.0, 0.0])
    viewmats = []
    for number, place in enumerate(_places()):
        middle = place + torch.tensor([0.0, 0.3, 0.0])
        for elevation, count in ((18.0, RING // 2), (40.0, RING - RING // 2)):
            eyes = sphere_grid([elevation], [360 / count * k + 7 * number + elevation for k in range(count)], 3.4)
            viewmats.append(look_at(eyes + middle, middle, up))
    poses, size = torch.cat(viewmats), (width, 3 * width // 4)
    K = intrinsics(50.0, *size)
    with one_torch_thread():
        photos = [demo_photo(corners, colors, Cameras(pose[None], K[None], *size)) for pose in poses]
    train, test = every_eighth(len(photos))
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randint(things, (points,), generator=generator)
    return Dataset(
        viewmats=poses.double(),
        Ks=K.double().expand(len(poses), 3, 3),
        images=StoredPictures(photos),
        names=[f"view_{index:03d}" for index in range(len(photos))],
        train=train,
        test=test,
        exact_points=corners[chosen].mean(dim=1).double()
        + 1e-4 * torch.rand((points, 3), generator=generator).double(),
        point_colors=colors[chosen].clamp(0, 1),
    )


def compare(views: Dataset, options: argparse.Namespace, seed: int) -> None:
    """A table of both, in which all random numbers follow from a seed."""
    config = TrainConfig.quick().changed(
        {
            "iterations": options.steps,
            "max_triangles": options.triangles,
            "pixels_per_triangle": None,
            "schedule.max_epochs": None,
            "asset": False,
            "output.evaluate_every": 0,
            "output.checkpoint_every": 0,
            "seed": seed,
        }
    )
    columns, rows = map(int, options.blocks.split("x"))
    grid, begin = cut(views, (columns, rows), up_of(views)), time.process_time()
    with TemporaryDirectory() as place:
        blocks = etsplat.train(views, Path(place) / "blocks", config, blocks=options.blocks, callbacks=[_tell])
        steps, seconds = blocks.metrics["iterations"], time.process_time() - begin
        print(f"seed {seed}, in blocks: {steps:,} steps, {seconds:.0f} s of processor time", flush=True)
        larger = config.changed({"iterations": steps, "max_triangles": blocks.soup.count})
        one = etsplat.train(views, Path(place) / "one", larger, callbacks=[_tell])
        print(f"one run: {steps:,} steps, {time.process_time() - begin - seconds:.0f} s of processor time", flush=True)
    print("| | triangles | PSNR | SSIM | FLIP | PSNR of sky | at seams | between | in the middle |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    for name, result in (("blocks", blocks), ("one run", one)):
        places = " | ".join(f"{psnr:.3f}" for psnr in by_place(result.soup, views, grid))
        numbers = [f"{result.metrics[key]:.3f}" for key in ("psnr", "ssim", "flip")]
        print(f"| {name} | {result.soup.count:,} | {' | '.join(numbers)} | {places} |", flush=True)


@torch.no_grad()
def by_place(soup: TriangleSoup, views: Dataset, grid: Grid) -> list[float]:
    """PSNR of the pixels of all test photos: of the sky, near borders between blocks, in between, and far from them."""
    corners, _, things = surface()
    distance = grid.distance(corners.mean(dim=1).double())
    distance[things:] = -1
    errors: list[list[Tensor]] = [[] for _ in range(4)]
    for index in views.test:
        camera = views.cameras[index]
        picture = soup.render(camera, backgrounds=torch.zeros(1, 3)).color[0].clamp(0, 1)
        wrong = (picture - as_float(views.images[index])).square().mean(dim=2)
        nearest = rasterize_opaque(corners, cameras=camera).triangle
        assert nearest is not None
        away = torch.where(nearest[0] >= 0, distance[nearest[0].long().clamp_min(0)], -1.0)
        place = torch.bucketize(away, torch.tensor([0.0, BORDER, MIDDLE], dtype=away.dtype), right=True)
        for number, some in enumerate(errors):
            some.append(wrong[place == number])
    return [float(-10 * torch.cat(some).double().mean().log10()) for some in errors]


def memory(points: int, blocks: str | None, width: int, pipe: Any) -> None:
    """How much this process grows by one run, or by each of a run in blocks."""
    views = capture(width, points)
    columns, rows = map(int, (blocks or "1x1").split("x"))
    config = TrainConfig.quick().changed(
        {
            "iterations": 40,
            "max_triangles": int(1.5 * points / (columns * rows)),
            "pixels_per_triangle": None,
            "asset": False,
            "pruning.importance": 0.0,
            "pruning.opacity": 0.0,
        }
    )
    marks: list[tuple[str, int]] = []
    before = reset_peak()
    stage = "coarse" if blocks else "one run"

    def tell(event: Event) -> None:
        nonlocal stage
        if isinstance(event, NoteEvent) and event.text.startswith(("block ", "the sky, ")):
            marks.append((stage, kibibytes("VmHWM") - before))
            stage = event.text.split(",")[0]
            reset_peak()

    with TemporaryDirectory() as place:
        etsplat.train(views, Path(place) / "run", config, blocks=blocks, callbacks=[tell])
    pipe.send([*marks, (stage, kibibytes("VmHWM") - before)])


def _tell(event: Event) -> None:
    if isinstance(event, NoteEvent):
        print(event, flush=True)
    elif isinstance(event, StageEvent) and event.done == event.total:
        print(f"{event.name}: done", flush=True)


def _places() -> list[Tensor]:
    columns, rows = TABLES
    return [
        torch.tensor([APART * (column - (columns - 1) / 2), 0.0, APART * (row - (rows - 1) / 2)])
        for column in range(columns)
        for row in range(rows)
    ]


def _coarser(
    corners: Float[Tensor, "F 3 3"], colors: Float[Tensor, "F 3"]
) -> tuple[Float[Tensor, "G 3 3"], Float[Tensor, "G 3"]]:
    """With all corners on a lattice, and of faces that are then the same the first."""
    places = (corners / LATTICE).round().long()
    number = (places - places.min() + 1) @ torch.tensor([1 << 40, 1 << 20, 1])
    ordered = number.sort(dim=1).values
    whole = ((ordered[:, 1:] != ordered[:, :-1]).all(dim=1)).nonzero()[:, 0]
    _, first = np.unique(ordered[whole].numpy(), axis=0, return_index=True)
    kept = whole[torch.from_numpy(np.sort(first))]
    return LATTICE * places[kept].float(), colors[kept]


def _ground() -> tuple[Float[Tensor, "F 3 3"], Float[Tensor, "F 3"]]:
    """Painted all over, so that a seam has something to show."""
    half = APART * max(TABLES) / 2 + 4
    line = np.linspace(-half, half, 121)
    x, z = np.meshgrid(line, line, indexing="ij")
    points = np.stack([x, np.full_like(x, -0.02), z], axis=2)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    corners = np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in ((a, b, c), (a, c, d))])
    u, v = corners.mean(axis=1)[:, 0], corners.mean(axis=1)[:, 2]
    waves = 0.5 + 0.25 * np.sin(5 * u + 2 * np.sin(2 * v)) + 0.25 * np.sin(4 * v + 3 * np.sin(1.7 * u))
    colors = waves[:, None] * [0.75, 0.6, 0.4] + (1 - waves[:, None]) * [0.2, 0.35, 0.2]
    return torch.from_numpy(corners).float(), torch.from_numpy(colors).float()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", default="2x2")
    parser.add_argument("--steps", type=int, default=1000, help="of each block")
    parser.add_argument("--triangles", type=int, default=5000, help="of each block, at most")
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--memory", type=int, default=0, metavar="POINTS")
    options = parser.parse_args()
    if not options.memory:
        views = capture(options.width, 6000)
        for seed in options.seeds:
            compare(views, options, seed)
        return
    print("| | MiB by which the process grows |\n|---|--:|")
    for blocks in (None, options.blocks):
        for name, grown in in_a_process(memory, options.memory, blocks, options.width):
            print(f"| {name} | {grown / 1024:,.0f} |", flush=True)


if __name__ == "__main__":
    main()
