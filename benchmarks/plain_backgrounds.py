"""How good masks of plain backgrounds are, and whether other photos are refused.

python -m benchmarks.plain_backgrounds

Every fourth training view of the objects in `data/objects` before five backgrounds, with noise, as JPEG of
quality 92: intersection over union with their alpha, mean and smallest. And of every third photo, at most twelve, of
each scene in `data/scenes`: how many are refused. All should be but those of lego, which is before white.
"""

import io
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

from etsplat.data.plain_backgrounds import find_object

DATA = Path(__file__).parents[2] / "shared" / "data"

Shade = Callable[[np.ndarray, np.ndarray], np.ndarray]

BACKGROUNDS: dict[str, tuple[Shade, float]] = {
    "white": (lambda x, y: 0.96 + 0 * x, 0.01),
    "black": (lambda x, y: 0.03 + 0 * x, 0.01),
    "grey, 0.45 to 0.8": (lambda x, y: 0.45 + 0.25 * y + 0.1 * x, 0.02),
    "green, uneven": (lambda x, y: np.array([0.15, 0.65, 0.25]) * (0.75 + 0.3 * x + 0.2 * y - 0.3 * x * y), 0.02),
    "blue, darker outside": (
        lambda x, y: np.array([0.3, 0.4, 0.6]) * (1 - 0.5 * ((x - 0.5) ** 2 + (y - 0.5) ** 2)),
        0.03,
    ),
}
"""What makes colours of x and y in [0, 1], and the standard deviation of the noise."""


def photographed(path: Path, shade: Shade, noise: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) uint8: an RGBA picture before a background, with noise, after JPEG."""
    picture = np.asarray(Image.open(path)) / 255
    height, width = picture.shape[:2]
    y, x = np.meshgrid(np.linspace(0, 1, height), np.linspace(0, 1, width), indexing="ij")
    colors = picture[..., :3] * picture[..., 3:] + shade(x[..., None], y[..., None]) * (1 - picture[..., 3:])
    colors += rng.normal(0, noise, colors.shape)
    memory = io.BytesIO()
    Image.fromarray((255 * colors.clip(0, 1)).round().astype(np.uint8)).save(memory, "JPEG", quality=92)
    return np.asarray(Image.open(memory))


def agreements(views: list[Path], shade: Shade, noise: float) -> tuple[list[float], int]:
    """Intersection over union of the views that are not refused, and how many are."""
    rng, found, refused = np.random.default_rng(0), [], 0
    for view in views:
        mask, truth = (
            find_object(photographed(view, shade, noise, rng)).mask,
            np.asarray(Image.open(view))[..., 3] >= 128,
        )
        if mask is None:
            refused += 1
        else:
            found.append(float((mask & truth).sum() / (mask | truth).sum()))
    return found, refused


def main() -> int:
    """The exit status."""
    objects = sorted(path for path in (DATA / "objects").iterdir() if path.is_dir())
    table = Table("background", "noise", *(path.name for path in objects), "refused")
    for name, (shade, noise) in BACKGROUNDS.items():
        cells, refused = [], 0
        for folder in objects:
            scores, without = agreements(sorted((folder / "train").iterdir())[::4], shade, noise)
            cells.append(f"{np.mean(scores):.3f} ({min(scores):.3f})")
            refused += without
        table.add_row(name, str(noise), *cells, str(refused))
    scenes = Table("scene", "photos", "refused")
    for folder in sorted(path for path in (DATA / "scenes").iterdir() if (path / "images").is_dir()):
        photos = sorted((folder / "images").iterdir())[::3][:12]
        found = [find_object(np.asarray(Image.open(photo).convert("RGB"))) for photo in photos]
        scenes.add_row(folder.name, str(len(photos)), str(sum(one.mask is None for one in found)))
    console = Console(width=140)
    console.print(table)
    console.print(scenes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
