"""The paper's teaser, of finished runs: from the sphere to the object above, from points to the scene below."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import bounding_ball
from etsplat.io.mesh_files import load_mesh
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.render_soup import draw
from etsplat.tasks.soup_trainer import start_trainer
from etsplat.tasks.train_config import TrainConfig
from studies.objects.pictures import draw_shape

_COLUMNS = {
    "reconstruct": ("start", "shape", "normals", "splatted", "truth"),
    "train": ("start", "opaque triangles", "normals", "splatted", "truth"),
}


def draw_teaser(runs: Sequence[Path]) -> Figure:
    """A row for each run: the start, shape or sharp triangles, normals, a test view splatted, and its photograph.

    Args:
        runs: folders of `etsplat reconstruct` and `etsplat train`.

    Raises:
        InputError: not a finished run; a soup's scene has gone.
    """
    figure = Figure(figsize=(2.2 * 5, 2.3 * len(runs)), layout="constrained")
    axes: Any = figure.subplots(len(runs), 5, squeeze=False)
    for row, folder in zip(axes, runs, strict=True):
        run = RunDirectory(folder)
        task = run.read_config()["task"] if is_run(folder) and run.metrics_path.is_file() else None
        if task not in _COLUMNS:
            raise InputError(f"{folder}: is not a finished run of `etsplat reconstruct` or `train`; name another")
        pictures = _shape_row(run) if task == "reconstruct" else _soup_row(run)
        for axis, picture, title in zip(row, pictures, _COLUMNS[task], strict=False):
            axis.imshow(picture)
            axis.set_title(title, fontsize=9)
        for axis in row:
            axis.axis("off")
    return figure


def _shape_row(run: RunDirectory) -> list[Any]:
    mesh = load_mesh(run.mesh_path(".ply"))
    center, radius = bounding_ball(mesh.vertices)
    unit = ((mesh.vertices.double() - center) / radius).float()
    begin = ReconstructConfig.from_file(run.config_path).start
    start, start_faces = icosphere(begin.level)
    shapes = [
        draw_shape(start * min(begin.radius, 1.0), start_faces),
        draw_shape(unit, mesh.faces),
        draw_shape(unit, mesh.faces, normals=True),
    ]
    renders = sorted(run.test.glob("*_render.png"))
    return [*(shape.numpy() for shape in shapes), *_test_view(run, len(renders) // 2, "render", "truth")]


@torch.no_grad()
def _soup_row(run: RunDirectory) -> list[Any]:
    """As the middle test view sees it."""
    opened = open_run(run.path, device="cpu")
    capture, config = opened.needed_capture(), TrainConfig.from_file(run.config_path)
    if not capture.test:
        raise InputError(f"{run.path}: its capture has no test view to show; name another run")
    number = len(capture.test) // 2
    view = capture.test[number]
    frame = capture.normalized() if config.normalize else capture
    start = start_trainer(frame, config).model.render(frame.cameras[view]).color[0].clamp(0, 1)
    normals = draw(opened.soup, capture.cameras[view], RenderConfig(normals=True))["normal"].clamp(0, 1)
    opaque, *others = _test_view(run, number, "opaque", "render", "truth")
    return [start.numpy(), opaque, normals.numpy(), *others]


def _test_view(run: RunDirectory, number: int, *kinds: str) -> list[Image.Image]:
    """Pictures that the run has drawn of a test view; none where there is none."""
    files = [run.test / f"{number:03d}_{kind}.png" for kind in kinds]
    return [Image.open(file) for file in files] if all(file.is_file() for file in files) else []
