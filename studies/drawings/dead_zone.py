"""The paper's thesis in its simplest form: one triangle, displaced from its target, is pulled back or is not."""

from typing import Any

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from etsplat.ops.adam import Adam
from etsplat.ops.rasterize import rasterize
from etsplat.ops.rasterize_opaque import render_opaque

KERNEL_COLORS = {"single_sided": "#b5542d", "bilateral": "#6c7a2c", "elastic": "#2060a8"}

SIZE = 96
"""Pixels of the picture's side, which is 4 units long."""

DISPLACEMENTS = tuple(0.5 * k for k in range(1, 13))
"""In inradii of the triangle (0.25 units, 6 pixels). Target and start are apart from 3 (side by side) to 4 on."""

SIGMAS = (1.0, 0.3, 0.05)

_RADIUS = 0.5  # of the circumscribed circle
_INRADIUS = _RADIUS / 2
_STEPS, _RATE = 400, 0.02


def target_triangle() -> Float[Tensor, "1 3 3"]:
    """Equilateral, around the origin, in the plane z = 1."""
    angles = torch.tensor([0.5, 0.5 + 2 / 3, 0.5 + 4 / 3]) * torch.pi
    return torch.stack([_RADIUS * angles.cos(), -_RADIUS * angles.sin(), torch.ones(3)], dim=1)[None]


def camera() -> dict[str, Any]:
    """Looks along z at the square [-2, 2]^2."""
    quarter, half = SIZE / 4, SIZE / 2
    K = torch.tensor([[[quarter, 0.0, half], [0.0, quarter, half], [0.0, 0.0, 1.0]]])
    return {"viewmats": torch.eye(4)[None], "Ks": K, "width": SIZE, "height": SIZE}


def pull(kernel: str, displacement: float, sigma: float, *, distance: str = "barycentric") -> float:
    """How hard the loss pulls the displaced triangle back: the derivative of L1 by the displacement, in inradii.

    Positive towards the target. Arguments as `remaining_distance`.
    """
    shift = torch.tensor(displacement, requires_grad=True)
    moved = target_triangle() + shift * _INRADIUS * torch.tensor([1.0, 0.0, 0.0])
    _loss(moved, kernel, sigma, distance).backward()
    return float(shift.grad) if shift.grad is not None else 0.0


def remaining_distance(kernel: str, displacement: float, sigma: float, *, distance: str = "barycentric") -> float:
    """Where the vertices end up, in inradii from the target's, mean over the three, after steps of Adam on L1.

    Args:
        kernel: of the moving triangle; the target is drawn opaque and antialiased.
        displacement: of the start, in inradii, along +x.
        sigma: held fixed: the question is how far the gradient reaches.
        distance: "barycentric" or "sdf".
    """
    truth = target_triangle()
    vertices = (truth + torch.tensor([displacement * _INRADIUS, 0.0, 0.0])).requires_grad_(True)
    adam = Adam({"vertices": vertices}, {"vertices": _RATE})
    for step in range(_STEPS):
        adam.learning_rates["vertices"] = _RATE * 0.01 ** (step / _STEPS)
        adam.zero_grad()
        _loss(vertices, kernel, sigma, distance).backward()
        if vertices.grad is not None:
            vertices.grad[..., 2] = 0.0  # in the plane: along the rays nothing is seen to change
        adam.step()
    return float((vertices.detach() - truth).norm(dim=2).mean()) / _INRADIUS


def draw_dead_zone() -> Figure:
    """Pull and distance that remains as functions of the displacement, for each kernel, from soft to sharp."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    axes: Any = figure.subplots(2, len(SIGMAS), sharex=True, sharey="row")
    for column, sigma in enumerate(SIGMAS):
        axes[1, column].plot(DISPLACEMENTS, DISPLACEMENTS, color="#999", linewidth=0.8, linestyle="--", label="start")
        for kernel, color in KERNEL_COLORS.items():
            style = {"color": color, "marker": "o", "markersize": 3, "label": kernel.replace("_", "-")}
            axes[0, column].plot(DISPLACEMENTS, [pull(kernel, d, sigma) for d in DISPLACEMENTS], **style)
            axes[1, column].plot(DISPLACEMENTS, [remaining_distance(kernel, d, sigma) for d in DISPLACEMENTS], **style)
        axes[0, column].set_title(f"σ = {sigma:g}", fontsize=10)
        axes[1, column].set_xlabel("displacement, in inradii")
        for axis in axes[:, column]:
            axis.grid(color="#eceef0")
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("pull towards the target at the start")
    axes[1, 0].set_ylabel("distance after 400 steps, in inradii")
    axes[1, 0].legend(frameon=False, fontsize=8)
    return figure


def _loss(vertices: Tensor, kernel: str, sigma: float, distance: str) -> Float[Tensor, ""]:
    """L1 between the triangle and the target's picture, white over black."""
    picture = render_opaque(target_triangle(), **camera(), face_colors=torch.ones(1, 1), supersampling=8).color
    one = {"opacities": torch.tensor([0.99]), "sigma": sigma, "face_colors": torch.ones(1, 1)}
    color = rasterize(vertices, **one, **camera(), kernel=kernel, distance=distance).color
    return (color - picture).abs().mean()
