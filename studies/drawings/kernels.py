"""The paper's explanatory figures, computed: kernels, seams, a soft triangle, the design axes, the teaser, dead zones.

Each function draws one figure and returns it. What the kernels are comes from `core.kernels`, what they look like from
the rasterizer itself.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.kernels import KERNELS
from etsplat.ops.rasterize import rasterize
from studies.drawings.dead_zone import draw_dead_zone

SIGMAS = (0.05, 0.25, 0.5, 1.0, 2.0)
TITLES = {"single_sided": "single-sided (TS)", "bilateral": "bilateral (2DTS)", "elastic": "elastic"}

_SIZE = 256
_PROFILE_SAMPLES = 10 * _SIZE + 1
"""Odd, for one on the seam. The square's corners then are 1024 pixels away, so that no rounding displaces the seam."""


def draw_kernels() -> Figure:
    """G(x) and dG/dx for several sigma, with the value on the boundary marked (the paper's figure func)."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    axes: Any = figure.subplots(2, 3, sharex=True, sharey="row")
    x = torch.linspace(1e-3, 2.0, 800, dtype=torch.float64)
    for column, (name, title) in enumerate(TITLES.items()):
        kernel = KERNELS[name]
        for index, value in enumerate(SIGMAS):
            sigma = torch.tensor(value, dtype=torch.float64)
            color = _shade(index)
            axes[0, column].plot(x, kernel.value(x, sigma), color=color, label=f"σ = {value:g}")
            axes[1, column].plot(x, kernel.gradient(x, sigma)[0], color=color)
            boundary = float(kernel.value(torch.ones((), dtype=torch.float64), sigma))
            axes[0, column].plot(1, boundary, "o", color=color, markersize=4)
        axes[0, column].set_title(title)
        for axis in axes[:, column]:
            axis.axvline(1, color="#999", linewidth=0.8, linestyle="--")
            axis.grid(color="#eceef0")
            axis.spines[["top", "right"]].set_visible(False)
        axes[1, column].set_xlabel("x  (0 centre, 1 boundary, 2 cut)")
    axes[0, 0].set_ylabel("G(x); dots: on the boundary")
    axes[1, 0].set_ylabel("dG/dx")
    axes[1, 0].set_ylim(-6, 0.3)
    axes[0, 2].legend(frameon=False, fontsize=8)
    return figure


def draw_edges() -> Figure:
    """Two connected opaque faces, drawn soft, and the profile across their common edge (the paper's edge_artifact)."""
    sigmas = (1.0, 0.3, 0.05)
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes: Any = figure.subplots(3, 4)
    square = torch.tensor([[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    for row, (name, title) in enumerate(TITLES.items()):
        for column, sigma in enumerate(sigmas):
            alpha = _splat(square[faces], name, sigma)
            axes[row, column].imshow(alpha, cmap="gray", vmin=0, vmax=1)
            axes[row, column].set_xticks([])
            axes[row, column].set_yticks([])
            axes[row, 3].plot(
                _profile(square[faces], name, sigma).numpy(), color=_shade(column + 1), label=f"σ = {sigma:g}"
            )
            if row == 0:
                axes[row, column].set_title(f"σ = {sigma:g}", fontsize=10)
        axes[row, 0].set_ylabel(title)
        axes[row, 3].set_ylim(0, 1.05)
        axes[row, 3].set_xticks([])
        axes[row, 3].spines[["top", "right"]].set_visible(False)
    axes[0, 3].set_title("opacity across the seam", fontsize=10)
    axes[1, 3].legend(frameon=False, fontsize=8, loc="lower center")  # the row with room below its curves
    return figure


def draw_soft_triangle() -> Figure:
    """One triangle, softened, with the level sets of x (the paper's figure softtri)."""
    figure = Figure(figsize=(11, 3.0), layout="constrained")
    axes: Any = figure.subplots(1, 4)
    triangle = torch.tensor([[[-0.55, -0.4], [0.6, -0.25], [-0.1, 0.55]]])
    distance = _barycentric_distance(triangle[0])
    extent = (-1, 1, 1, -1)
    for axis, (name, title) in zip(axes, TITLES.items(), strict=False):
        axis.imshow(_splat(triangle, name, 0.7), cmap="magma", vmin=0, vmax=1, extent=extent)
        axis.set_title(f"{title}, σ = 0.7", fontsize=10)
    axes[3].imshow(distance.clamp(max=3), cmap="gray", extent=extent)
    axes[3].set_title("x = 1 - 3 min(a₁, a₂, a₃)", fontsize=10)
    for axis in axes:
        lines = axis.contour(distance, [0.5, 1.0, 2.0], extent=(-1, 1, -1, 1), colors="w", linewidths=[0.6, 1.6, 0.6])
        axis.clabel(lines, fontsize=7)
        axis.set_xlim(-1, 1)
        axis.set_ylim(1, -1)
        axis.set_xticks([])
        axis.set_yticks([])
    return figure


def draw_axes() -> Figure:
    """The paper's table kernel_axes, from the kernels themselves: support, G(1), gradient outside, size when soft."""
    figure = Figure(figsize=(9, 2.4), layout="constrained")
    axis = figure.add_subplot()
    axis.axis("off")
    head = ["kernel", "support", "G(1) at σ = 1 … 0.05", "gradient outside", "area at σ = 1 … 0.05", "seam at σ = 0.05"]
    table = axis.table(cellText=[_axes_row(name) for name in TITLES], colLabels=head, loc="center", cellLoc="center")
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    table.scale(1, 1.9)
    for cell in table.get_celld().values():
        cell.set_edgecolor("#c9ced3")
    return figure


def _axes_row(name: str) -> list[str]:
    kernel = KERNELS[name]
    soft, sharp, outside = (torch.tensor(value, dtype=torch.float64) for value in (1.0, 0.05, 1.2))
    one = torch.ones((), dtype=torch.float64)
    low, high = float(kernel.value(one, soft)), float(kernel.value(one, sharp))
    reaches = float(kernel.value(outside, soft)) > 0
    gradient = float(kernel.gradient(outside, soft)[0]) != 0
    seam = 1 - (1 - high) ** 2
    return [
        TITLES[name],
        "both sides" if reaches else "inside",
        f"{low:.2f} … {high:.2f}" if abs(low - high) > 0.01 else f"{high:.2f}, fixed",
        "yes" if gradient else "no",
        f"{float(kernel.area(soft)):.2f} … {float(kernel.area(sharp)):.2f}",
        f"{seam:.2f}",
    ]


def _shade(index: int) -> tuple[float, float, float]:
    """From dark blue to light orange."""
    t = index / (len(SIGMAS) - 1)
    return (0.10 + 0.80 * t, 0.25 + 0.25 * t, 0.60 - 0.45 * t)


def _splat(
    triangles: Float[Tensor, "N 3 2"], kernel: str, sigma: float, width: int = _SIZE, height: int = _SIZE
) -> Float[Tensor, "H W"]:
    """Opacity of flat triangles in a picture that reaches from -1 to 1 in x, drawn by the rasterizer."""
    flat = torch.cat([triangles, torch.ones(*triangles.shape[:2], 1)], dim=2)
    scale = width // 2
    K = torch.tensor([[[scale, 0, width / 2], [0, scale, height / 2], [0, 0, 1]]])
    ones = torch.ones(len(flat))
    cameras = Cameras(torch.eye(4)[None], K, width, height)
    drawn = rasterize(flat, opacities=ones, sigma=sigma, face_colors=ones[:, None], cameras=cameras, kernel=kernel)
    return drawn.color[0, ..., 0]


def _profile(triangles: Float[Tensor, "N 3 2"], kernel: str, sigma: float) -> Float[Tensor, " W"]:
    """Opacity along the diagonal that crosses the seam, from corner to corner of the picture."""
    turned = triangles @ torch.tensor([[1.0, 1.0], [-1.0, 1.0]]) / 2  # the diagonal becomes the x axis from -1 to 1
    return _splat(turned, kernel, sigma, width=_PROFILE_SAMPLES, height=1)[0]


def _barycentric_distance(corners: Float[Tensor, "3 2"]) -> Float[Tensor, "H W"]:
    axis = (torch.arange(_SIZE) + 0.5) / (_SIZE / 2) - 1
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    points = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    matrix = torch.cat([corners.T, torch.ones(1, 3)])
    return 1 - 3 * torch.linalg.solve(matrix, points.reshape(-1, 3).T).amin(dim=0).reshape(_SIZE, _SIZE)


FIGURES: dict[str, Callable[[], Figure]] = {
    "kernels": draw_kernels,
    "edges": draw_edges,
    "soft-triangle": draw_soft_triangle,
    "axes": draw_axes,
    "dead-zone": draw_dead_zone,
}
"""By the name of the command; the teaser needs a run and is apart."""
