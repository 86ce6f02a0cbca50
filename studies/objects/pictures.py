"""A grid's pictures: convergence of every variant, and reconstructions beside the truth."""

import statistics
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.photograph import orbit_cameras, shade_faces
from etsplat.geometry.measures import bounding_ball
from etsplat.io.atomic import atomic_write
from etsplat.io.mesh_files import load_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.ops.rasterize_opaque import render_opaque
from studies.grid.cells import Cell

TILE = 360
OBJECTS = 6
"""At most so many objects in the qualitative figure."""

_MARGIN = 8
"""Pixels around what a picture shows."""

_VIEW = 17
"""Of the orbit: at the height of the object, turned by 45 degrees; a test view."""


def plot_convergence(cells: Sequence[Cell], variants: Sequence[str], path: Path) -> None:
    """Chamfer distance and PSNR, geometric and plain mean over the objects, against iterations and seconds."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    for variant in variants:
        histories = [
            [line for line in RunDirectory(cell.folder).read_history() if "psnr" in line]
            for cell in cells
            if cell.variant == variant and cell.state == "done"
        ]
        if not histories:
            continue
        common = set.intersection(*({line["iteration"] for line in history} for history in histories))
        lines = [[line for line in history if line["iteration"] in common] for history in histories]
        iterations = sorted(common)
        seconds = [statistics.fmean(line["seconds"] for line in step) for step in zip(*lines, strict=True)]
        for row, (key, mean) in enumerate((("chamfer", statistics.geometric_mean), ("psnr", statistics.fmean))):
            if not all(key in line for history in lines for line in history):
                continue
            scale = 1e3 if key == "chamfer" else 1.0
            values = [mean([scale * line[key] for line in step]) for step in zip(*lines, strict=True)]
            for column, x in enumerate((iterations, seconds)):
                axes[row, column].plot(x, values, label=variant, linewidth=1.5)
    for row, title in enumerate(("Chamfer distance × 10³, geometric mean", "PSNR on test views, dB")):
        for column, unit in enumerate(("iteration", "seconds of optimisation")):
            axes[row, column].set_title(title, loc="left", fontsize=10)
            axes[row, column].set_xlabel(unit)
            axes[row, column].grid(color="#e4e6e8")
            axes[row, column].spines[["top", "right"]].set_visible(False)
        axes[0, row].set_yscale("log")
    handles, labels = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=8, loc="outside lower center", ncols=4)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=130)


def draw_qualitative(cells: Sequence[Cell], variants: Sequence[str], path: Path) -> None:
    """Reconstructed meshes in the photographs' light, and their normals, with the truth at the left."""
    objects = list(dict.fromkeys(cell.object for cell in cells if cell.state == "done"))[:OBJECTS]
    figure = Figure(figsize=(2.0 * (len(variants) + 1), 4.0 * len(objects)), layout="constrained")
    grid: Any = figure.subplots(2 * len(objects), len(variants) + 1, squeeze=False)
    for row, name in enumerate(objects):
        done = {cell.variant: cell for cell in reversed(cells) if cell.object == name and cell.state == "done"}
        truth = load_mesh(next(iter(done.values())).source)
        center, radius = bounding_ball(truth.vertices)
        meshes = {"truth": (truth.vertices, truth.faces)}
        for variant in variants:
            if variant in done:
                mesh = load_mesh(RunDirectory(done[variant].folder).mesh_path(".ply"))
                meshes[variant] = (mesh.vertices, mesh.faces)
        pictures = {
            title: [
                draw_shape(((vertices.double() - center) / radius).float(), faces, normals=half)
                for half in (False, True)
            ]
            for title, (vertices, faces) in meshes.items()
        }
        shown = _bounds([picture for pair in pictures.values() for picture in pair])
        for column, title in enumerate(["truth", *variants]):
            for half in range(2):
                axis = grid[2 * row + half, column]
                axis.axis("off")
                if title in pictures:
                    axis.imshow(pictures[title][half][shown].numpy())
                if row == 0 and half == 0:
                    axis.set_title(_wrapped(title), fontsize=8)
        grid[2 * row, 0].text(
            -0.05, 0.5, name, rotation=90, va="center", ha="right", transform=grid[2 * row, 0].transAxes
        )
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)


def _wrapped(title: str) -> str:
    """In lines that fit above a picture; settings break at their commas."""
    return "\n".join(line for part in title.split(",") for line in textwrap.wrap(part, 24))


def _bounds(pictures: Sequence[Float[Tensor, "H W 3"]]) -> tuple[slice, slice]:
    """The rows and columns where any of them is not white, and a margin."""
    drawn = torch.stack([(picture < 1).any(dim=2) for picture in pictures]).any(dim=0)
    slices = []
    for line in (drawn.any(dim=1), drawn.any(dim=0)):
        used = line.nonzero()[:, 0].tolist() or [0, TILE - 1]
        slices.append(slice(max(0, used[0] - _MARGIN), used[-1] + 1 + _MARGIN))
    return slices[0], slices[1]


def draw_shape(
    vertices: Tensor, faces: Tensor, *, normals: bool = False, camera: Cameras | None = None
) -> Float[Tensor, "H W 3"]:
    """One picture over white, of the shape in the photographs' light or of its normals as colours."""
    camera = orbit_cameras(TILE, TILE)[_VIEW] if camera is None else camera
    if normals:
        corners = vertices[faces].double()
        cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        in_view = torch.nn.functional.normalize(cross, dim=1).float() @ camera.viewmats[0, :3, :3].T
        colors = 0.5 + 0.5 * in_view * torch.tensor([1.0, -1.0, -1.0])
    else:
        colors = shade_faces(vertices, faces)
    drawn = render_opaque(vertices, face_colors=colors, cameras=camera, faces=faces, supersampling=3)
    return (drawn.color[0] + 1 - drawn.alpha[0]).clamp(0, 1)
