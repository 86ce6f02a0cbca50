"""The upper half of the paper's teaser: from the sphere to the object, of finished runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from PIL import Image

from etsplat.bench.figures import draw_shape
from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import bounding_ball
from etsplat.io.mesh_files import load_mesh
from etsplat.io.run_directory import RunDirectory

_COLUMNS = ("start", "shape", "normals", "splatted", "truth")


def draw_teaser(runs: Sequence[Path]) -> Figure:
    """A row for each run: the start, the reconstructed shape and its normals, and a test view beside the photograph.

    Raises:
        InputError: not a finished run.
    """
    figure = Figure(figsize=(2.2 * len(_COLUMNS), 2.3 * len(runs)), layout="constrained")
    axes: Any = figure.subplots(len(runs), len(_COLUMNS), squeeze=False)
    for row, folder in zip(axes, runs, strict=True):
        run = RunDirectory(folder)
        if not run.mesh_path(".ply").is_file() or not run.metrics_path.is_file():
            raise InputError(f"{folder}: is not a finished run of `etsplat reconstruct`; name another")
        mesh = load_mesh(run.mesh_path(".ply"))
        center, radius = bounding_ball(mesh.vertices)
        unit = ((mesh.vertices.double() - center) / radius).float()
        config = run.read_config()["config"]
        start, start_faces = icosphere(config["start_level"])
        pictures = [
            draw_shape(start * min(config["start_radius"], 1.0), start_faces),
            draw_shape(unit, mesh.faces),
            draw_shape(unit, mesh.faces, normals=True),
        ]
        pictures = [torch.as_tensor(picture).numpy() for picture in pictures]
        renders = sorted(run.test.glob("*_render.png"))
        if renders:
            render = renders[len(renders) // 2]
            pictures += [Image.open(render), Image.open(render.with_name(render.name.replace("_render", "_truth")))]
        for axis, picture, title in zip(row, pictures, _COLUMNS, strict=False):
            axis.imshow(picture)
            axis.set_title(title, fontsize=9)
        for axis in row:
            axis.axis("off")
    return figure
