"""What memory a run of novel-view synthesis comes to need, counted before it begins (measured: docs/blocks.md)."""

from dataclasses import dataclass

import torch

from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.core.workers import workers
from etsplat.data.dataset import Dataset
from etsplat.data.loader import stay_on
from etsplat.io.memory import available_memory
from etsplat.model.surroundings import SPHERE_TRIANGLES
from etsplat.tasks.opaque import mesh_views
from etsplat.tasks.pixel_limits import random_count
from etsplat.tasks.soft_views import soft_view_count
from etsplat.tasks.train_config import TrainConfig

STATISTICS = 16
"""Bytes of what is remembered of a triangle between edits."""

PACE = 4
"""Bytes of how fast the vertices of a triangle are."""

PASSING = 160
"""Bytes that come and go for each triangle in a step: what it is drawn from (colour, opacity, softness) with gradients,
statistics of the view, its outline in the picture, its place in the order of depth."""

RECOLORED = 60
"""Bytes of plain colours that learn alone: values, gradients, both moments of Adam, those of the best state."""

PLANNED = 200
"""Bytes of an edit for each triangle: where it comes from, how likely it has children, those in their places."""

ON_DEVICES = 1500
"""Bytes for each triangle on a GPU, at least: torch keeps there what it was given once."""

BYTES_PER_PIXEL = 400
"""Of a step's pictures and the rasterizer's lists."""

POOLED = 384 << 20
"""Bytes that the CPU engine and the C library keep for the next step, at most."""

LIBRARIES = 128 << 20
"""Bytes of what is loaded on the way."""

FEWEST = 1000
"""Triangles that it makes sense to ask for."""


@dataclass(frozen=True)
class TrainMemory:
    """Bytes that a run needs.

    Attributes:
        triangles: how many there may be.
        per_triangle: of each.
        photos: how many there are.
        kept: of all photos that stay.
        pictures: of the pictures of a step.
        soft: of views of the soup, which its opaque mesh is fitted to as well.
        around: of triangles that are drawn in them and stay where they are.
        pooled: what is kept for the next step, and of libraries.
    """

    triangles: int
    per_triangle: int
    photos: int
    kept: int
    pictures: int
    soft: int
    around: int
    pooled: int

    @property
    def total(self) -> int:
        """All of it."""
        return self.triangles * self.per_triangle + self.kept + self.pictures + self.soft + self.around + self.pooled

    def __str__(self) -> str:
        parts = [f"{self.per_triangle:,} bytes for each of {self.triangles:,} triangles"]
        if self.kept:
            parts.append(f"{in_words(self.kept // self.photos)} for each of {self.photos:,} photos")
        if self.soft:
            parts.append(f"{in_words(self.soft)} for views of the soup")
        return f"at most {in_words(self.total)} of memory: {', '.join(parts)}, {in_words(self.pictures)} for a step"


def bytes_per_triangle(sh_degree: int, *, watched: bool) -> int:
    """Bytes of a triangle while a run of engine "cpu" needs most: in a step, or in an edit.

    Args:
        sh_degree: of its colours.
        watched: whether photos watch the run, for which its best state is kept.
    """
    bands = 3 * (sh_degree + 1) ** 2
    values = bytes_of_values(sh_degree)
    lasting = 3 * values + STATISTICS + PACE + (values if watched else 0)  # with both moments of Adam
    step = values + PASSING  # gradients
    largest = 4 * max(9, bands - 3)
    edit = values + largest + PLANNED  # new values beside the old ones, and a moment of the largest tensor likewise
    return lasting + max(step, edit)


def bytes_of_values(sh_degree: int) -> int:
    """Bytes of a triangle of a soup: corners, opacity, softness, colours."""
    return 4 * (9 + 1 + 1 + 3 * (sh_degree + 1) ** 2)


def bytes_around(triangles: int, sh_degree: int, *, recolored: bool = False) -> int:
    """Bytes of triangles that are drawn as well and stay where they are; `recolored` if their plain colours learn."""
    corners = 36  # once more, in the frame of the run
    return triangles * (bytes_of_values(sh_degree) + corners + PASSING + (RECOLORED if recolored else 0))


def memory_of(capture: Dataset, config: TrainConfig, most: int, device: torch.device, around: int = 0) -> TrainMemory:
    """What a run may come to need.

    Args:
        capture: with all its photos.
        config: settings.
        most: triangles that there may be.
        device: where it runs.
        around: as of `bytes_around`.
    """
    pixels = max(width * height for width, height in capture.images.sizes)
    points = random_count(capture, config) if capture.exact_points is None else len(capture.exact_points)
    triangles = max(most, points + (SPHERE_TRIANGLES if config.sky == "sphere" else 0))
    each = bytes_per_triangle(config.drawing.sh_degree, watched=bool(capture.watched))
    stays = not capture.images.streamed and stay_on(device, capture.images.total_bytes)
    kept = capture.images.total_bytes if stays else 0
    on_cpu = device.type == "cpu"
    pooled = LIBRARIES + (min(POOLED, triangles * each // 4) if on_cpu else 0)
    each = each if on_cpu else max(each, ON_DEVICES)
    beside = config.asset and config.finish == "none"
    soft = 4 * pixels * soft_view_count(capture, mesh_views(config)) if beside else 0
    return TrainMemory(triangles, each, len(capture), kept, pixels * BYTES_PER_PIXEL, soft, around, pooled)


def check_memory(
    capture: Dataset, config: TrainConfig, most: int, device: torch.device, around: int = 0
) -> TrainMemory:
    """What a run may come to need, where that is there.

    Args:
        capture: as of `memory_of`; photos that are in memory already are not asked for again.
        config: as there.
        most: as there.
        device: as there.
        around: as there.

    Raises:
        InputError: it is not; the message says what would fit.
    """
    needed = memory_of(capture, config, most, device, around)
    if device.type == "cuda":
        free, there = torch.cuda.mem_get_info(device)[0], 0
    else:
        free, there = available_memory() // workers().neighbours, capture.images.held_bytes if needed.kept else 0
    lacking = needed.total - there - free
    if lacking <= 0:
        return needed
    fitting = int(needed.triangles * (1 - lacking / (needed.triangles * needed.per_triangle + needed.around)))
    remedy = f"set it to {fitting} or less" if FEWEST <= fitting < config.max_triangles else "set it to less"
    if capture.exact_points is not None and fitting < len(capture.exact_points):
        remedy = f"the capture starts from {len(capture.exact_points):,} points; thin them"
    others = f"make photos smaller with {option('width', ...)}, or divide the scene with {option('blocks', ...)}"
    raise InputError(
        f"max_triangles: {needed.triangles:,} triangles may need {in_words(needed.total - there)} and "
        f"{in_words(free)} are free; {remedy}, {others}"
    )


def in_words(count: int) -> str:
    """So many bytes."""
    if count >= 2**30:
        return f"{count / 2**30:.1f} GiB"
    return f"{count >> 20:,} MiB" if count >= 2**20 else f"{-(-count // 2**10):,} KiB"
