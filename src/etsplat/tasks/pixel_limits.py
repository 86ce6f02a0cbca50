"""How many triangles the pixels of photos carry: more learn noise by heart."""

from dataclasses import replace

from etsplat.data.dataset import Dataset
from etsplat.data.surface_pixels import surface_pixels
from etsplat.model.soup_init import SKY_FRACTION
from etsplat.model.surroundings import SPHERE_TRIANGLES
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train_config import TrainConfig

_FEWEST = 5000
"""Iterations that are left of a run that had more: shapes and outlines need them however few the faces are."""

_OPAQUE = 5 / 3
"""So many times as many pixels as a soft triangle an opaque one needs: no others lie over it, and in training none is
left out by chance."""


def triangle_limit(capture: Dataset, config: TrainConfig) -> int:
    """How many triangles there may be: `max_triangles`, or fewer where the training photos have few pixels."""
    pixels = sum(width * height for width, height in (capture.images.sizes[index] for index in capture.train))
    shared = 1.0 if config.finish == "none" else _OPAQUE
    return _carried(pixels / shared, config.pixels_per_triangle, config.max_triangles)


def random_count(capture: Dataset, config: TrainConfig) -> int:
    """How many random triangles a run of a capture without points starts from: with its sky no more than may be.

    More would be a fog that no photo carries, and takes twice the time for as good a result or a worse one.
    """
    limit = triangle_limit(capture, config)
    room = limit - SPHERE_TRIANGLES if config.sky == "sphere" else limit
    room = int(room / (1 + SKY_FRACTION)) if config.sky == "dome" else room
    return min(config.start.points, max(1, room, limit // 2))


def within_pixels(
    config: ReconstructConfig, views: Dataset, start: TriangleMesh
) -> tuple[ReconstructConfig, str | None]:
    """The settings with no more faces than photos have pixels for, and of long runs with fewer iterations.

    Args:
        config: as asked for.
        views: of which the run is.
        start: what it starts from, whose faces stay.

    Returns:
        What the run is made with; and a sentence about it, or None if it is what was asked for.
    """
    if config.pixels_per_face is None:
        return config, None
    vertices, corners = start.surface()
    pixels = surface_pixels(views, vertices, corners)
    faces = max(start.count, _carried(pixels, config.pixels_per_face, config.max_faces))
    if faces >= config.max_faces:
        return config, None
    shorter = max(_FEWEST, round(config.iterations * faces / config.max_faces))
    iterations = min(config.iterations, shorter)
    steps = f", and {iterations:,} iterations, not {config.iterations:,}" if iterations < config.iterations else ""
    setting = f"pixels_per_face {config.pixels_per_face:g}"
    about = f"few pixels: at most {faces:,} faces, not {config.max_faces:,}{steps} ({setting})"
    return replace(config, max_faces=faces, iterations=iterations), about


def _carried(pixels: float, each: float | None, most: int) -> int:
    """So many triangles, with so many pixels for each, or any number of pixels for None."""
    return most if each is None else min(most, max(1, int(pixels / each)))
