"""Masks of objects that stand on a table in a room, beside their true ones.

python -m benchmarks.standing_objects OBJECTS --out FOLDER [--objects NAMES] [--tables NAMES]

Those photos of each object of `data/objects` that look down at it by 5 degrees and more are put before a round table
and a room, as opaque PNG: the capture in `FOLDER/OBJECT-TABLE`. `etsplat data masks --by surface` then writes
`FOLDER/OBJECT-TABLE-masks`. Printed are intersection over union with the true masks, mean and smallest, the part of
the masks that is not the object and the part of the object that is not in them, in percent, and seconds by the clock.
`FOLDER/OBJECT-TABLE-true` has the true masks, so that `etsplat reconstruct` can be run with either. Tables:

    wood    a pattern in browns
    cloth   checks of two colours
    white   nearly one colour, that light makes darker towards one side
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table
from scipy.ndimage import gaussian_filter

from etsplat.tasks.object_masks import mask_capture
from studies.objects.subjects import SURFACE

LOWEST = 5.0
"""Degrees above the table's plane."""

TABLE, FLOOR, ROOM = 1.9, 1.3, 7.0
"""Radius of the table, how far the floor is below it, and the radius of the room; the object's is 1."""

Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Colours (..., 3) of coordinates x and y, with an object of radius 1."""


def grain(seed: int, sigma: float, stretch: float = 1.0) -> Paint:
    """A pattern of one number in [0, 1] of any coordinates: noise, blurred, again and again, 12 units wide."""
    noise = np.random.default_rng(seed).normal(size=(1024, 1024))
    blurred = gaussian_filter(noise, (sigma, sigma * stretch), mode="wrap")
    blurred += blurred.std() * gaussian_filter(noise[::-1], 0.7, mode="wrap")
    values = (blurred - blurred.min()) / np.ptp(blurred)

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        column, row = (np.floor(each / 12 * 1024).astype(np.int64) % 1024 for each in (x, y))
        return values[row, column][..., None]

    return at


WOOD, CARPET, WALL = grain(0, 2, 12), grain(1, 5), grain(2, 12)

TABLES: dict[str, Paint] = {
    "wood": lambda x, y: np.array([0.30, 0.17, 0.08]) + 0.5 * WOOD(x, y) * np.array([1.0, 0.75, 0.5]),
    "cloth": lambda x, y: np.where(
        ((np.floor(6 * x) + np.floor(6 * y)) % 2 == 0)[..., None], [0.75, 0.2, 0.2], [0.9, 0.88, 0.8]
    ),
    "white": lambda x, y: 0.8 + 0.06 * (x / TABLE)[..., None] + 0.02 * WOOD(x, y) + np.zeros(3),
}


def room(eye: np.ndarray, rays: np.ndarray, ground: float, table: Paint) -> np.ndarray:
    """(H, W, 3) what is around the object, in [0, 1]: z is up, and rays begin at the eye."""
    down = np.where(np.abs(rays[..., 2]) < 1e-9, -1e-9, rays[..., 2])

    def meets(height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        along = (height - eye[2]) / down
        return along, eye[0] + along * rays[..., 0], eye[1] + along * rays[..., 1]

    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    half = unit @ eye
    far = eye + unit * (np.sqrt(half**2 - eye @ eye + ROOM**2) - half)[..., None]
    colors = np.array([0.25, 0.3, 0.4]) + 0.6 * WALL(2 * np.arctan2(far[..., 1], far[..., 0]), far[..., 2])
    for height, radius, paint in (
        (ground - FLOOR, ROOM, lambda x, y: np.array([0.2, 0.25, 0.2]) + 0.5 * CARPET(x, y)),
        (ground, TABLE, table),
    ):
        along, x, y = meets(height)
        colors = np.where(((along > 0) & (np.hypot(x, y) < radius))[..., None], paint(x, y), colors)
    return colors.clip(0, 1)


def write_capture(folder: Path, table: Paint, scene: Path, true: Path) -> int:
    """An object's photos on the table, and its true masks; how many."""
    ground = min(float(line.split()[3]) for line in (folder / SURFACE).read_text().splitlines() if line[:2] == "v ")
    rng, count = np.random.default_rng(0), 0
    for split in ("train", "test"):
        document = json.loads((folder / f"transforms_{split}.json").read_text())
        frames = []
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            eye = pose[:3, 3]
            if (eye[2] - ground) < np.sin(np.radians(LOWEST)) * np.linalg.norm(eye):
                continue
            picture = np.asarray(Image.open(folder / f"{frame['file_path']}.png")) / 255
            height, width = picture.shape[:2]
            focal = width / 2 / np.tan(document["camera_angle_x"] / 2)
            rows, columns = np.mgrid[:height, :width] + 0.5
            local = [(columns - width / 2) / focal, -(rows - height / 2) / focal, -np.ones_like(rows)]
            around = room(eye, np.stack(local, axis=-1) @ pose[:3, :3].T, ground, table)
            colors = picture[..., :3] * picture[..., 3:] + around * (1 - picture[..., 3:])
            colors += rng.normal(0, 0.01, colors.shape)
            name = Path(frame["file_path"]).name
            for path, pixels in (
                (scene / split / f"{split}_{name}.png", colors),
                (true / f"{split}_{name}.png", picture[..., 3]),
            ):
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray((255 * pixels.clip(0, 1)).round().astype(np.uint8)).save(path)
            frames.append({**frame, "file_path": f"{split}/{split}_{name}"})
        (scene / f"transforms_{split}.json").write_text(json.dumps({**document, "frames": frames}))
        count += len(frames)
    return count


def compare(masks: Path, true: Path) -> tuple[float, float, float, float]:
    """IoU, mean and smallest; what is too much and what lacks, in the mean, as parts of the true mask."""
    rows = []
    for path in sorted(true.glob("*.png")):
        truth, found = np.asarray(Image.open(path)) >= 128, masks / path.name
        mask = np.asarray(Image.open(found)) >= 128 if found.exists() else np.zeros_like(truth)
        both, size = (mask & truth).sum(), truth.sum()
        rows.append((both / (mask | truth).sum(), (mask & ~truth).sum() / size, (truth & ~mask).sum() / size))
    iou, more, less = np.array(rows).T
    return float(iou.mean()), float(iou.min()), float(more.mean()), float(less.mean())


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--objects", nargs="+")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=list(TABLES))
    arguments = parser.parse_args()
    objects = arguments.objects or sorted(path.name for path in arguments.folder.iterdir() if path.is_dir())
    table = Table("object", "table", "photos", "IoU", "smallest", "too much, %", "lacks, %", "seconds")
    for name in objects:
        for kind in arguments.tables:
            scene, true, masks = (arguments.out / f"{name}-{kind}{end}" for end in ("", "-true", "-masks"))
            count = write_capture(arguments.folder / name, TABLES[kind], scene, true)
            begun = time.monotonic()
            mask_capture(scene, masks, by="surface")
            seconds = time.monotonic() - begun
            iou, least, more, less = compare(masks, true)
            table.add_row(
                name, kind, str(count), f"{iou:.4f}", f"{least:.4f}", f"{100 * more:.2f}", f"{100 * less:.2f}",
                f"{seconds:.0f}",
            )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
