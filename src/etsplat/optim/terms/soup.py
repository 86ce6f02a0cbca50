"""Terms that keep a soup in order (paper section 3.4, L_nvs)."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.forward_mode import refuse_forward_mode
from etsplat.model.model import model_for
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.normal_consistency import normal_consistency
from etsplat.ops.triangle_area import mean_area
from etsplat.optim.objective import Drawing, Term
from etsplat.optim.schedules import Scheduled

Spared = Callable[[Float[Tensor, "N 3 3"]], Bool[Tensor, " N"]]


class Opacity(Term):
    """The mean opacity.

    Example:
        >>> points = etsplat.StartPoints(torch.rand(50, 3), torch.full((50, 3), 0.5))
        >>> soup = etsplat.start_soup(points, torch.Generator(), scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(soup, camera, torch.zeros(1, 16, 16, 3), None, black, soup.render(camera))

        >>> round(etsplat.Opacity()(drawing).item(), 4)
        0.3
    """

    name = "opacity"
    looks_at = "parameters"

    def __init__(self, weight: Scheduled = 1.0, spared: Spared | None = None) -> None:
        """Takes its weight, and which triangles count as transparent, by their corners; None for none."""
        super().__init__(weight)
        self._spared = spared

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of the soup."""
        opacities = drawing.model.opacities
        if self._spared is not None:
            opacities = torch.where(self._spared(drawing.model.vertices), 0.0, opacities)
        return opacities.mean()


class Size(Term):
    """The reciprocal of the mean area.

    Example:
        >>> points = etsplat.StartPoints(torch.rand(50, 3), torch.full((50, 3), 0.5))
        >>> soup = etsplat.start_soup(points, torch.Generator(), scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(soup, camera, torch.zeros(1, 16, 16, 3), None, black, soup.render(camera))

        >>> term = etsplat.Size()
        >>> (term(drawing) ** term.power).item() > 0
        True
    """

    name = "size"
    looks_at = "parameters"
    power = -1

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Mean area."""
        return mean_area(model_for(self, drawing.model, TriangleSoup).vertices)


class Harmonics(Term):
    """How much colours depend on the direction: the sum of squares of a triangle's coefficients, the mean over all.

    The constant band does not count. By the others a triangle that few photos show fits each of them, and other views
    then see streaks and patches.

    Example:
        >>> points = etsplat.StartPoints(torch.rand(50, 3), torch.full((50, 3), 0.5))
        >>> soup = etsplat.start_soup(points, torch.Generator(), scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(soup, camera, torch.zeros(1, 16, 16, 3), None, black, soup.render(camera))

        >>> etsplat.Harmonics()(drawing).item()  # a soup begins with the same colour from all sides
        0.0
    """

    name = "harmonics"
    looks_at = "parameters"
    squares = "sh_rest"

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of the soup."""
        coefficients = model_for(self, drawing.model, TriangleSoup).sh_rest
        return _SquaredNorm.apply(coefficients) / len(coefficients)


class _SquaredNorm(torch.autograd.Function):
    """The sum of squares. By torch's own derivatives arrays as large as the soup's largest are written thrice."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return torch.linalg.vector_norm(values).square()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (values,) = ctx.saved_tensors
        return values * (2 * gradient)

    jvp = staticmethod(refuse_forward_mode)


class DepthNormals(Term):
    """How far normals are from those of the depth image, where something is opaque (ops/normal_consistency.py).

    Example:
        >>> points = etsplat.StartPoints(torch.rand(50, 3), torch.full((50, 3), 0.5))
        >>> soup = etsplat.start_soup(points, torch.Generator(), scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> seen = soup.render(camera, outputs=etsplat.DepthNormals.outputs)
        >>> drawing = etsplat.Drawing(soup, camera, torch.zeros(1, 16, 16, 3), None, black, seen)

        >>> 0 <= etsplat.DepthNormals()(drawing).item() <= 2
        True
    """

    name = "depth_normal"
    outputs = ("normal", "median_depth")

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of one view."""
        rendering, camera = drawing.rendering, drawing.camera
        assert rendering.normal is not None
        assert rendering.median_depth is not None
        return normal_consistency(
            rendering.normal, rendering.median_depth, rendering.alpha.detach(), camera.viewmats, camera.Ks
        )


class Distortion(Term):
    """The mean spread of triangles along a line of sight.

    Example:
        >>> points = etsplat.StartPoints(torch.rand(50, 3), torch.full((50, 3), 0.5))
        >>> soup = etsplat.start_soup(points, torch.Generator(), scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> seen = soup.render(camera, outputs=etsplat.Distortion.outputs)
        >>> drawing = etsplat.Drawing(soup, camera, torch.zeros(1, 16, 16, 3), None, black, seen)

        >>> etsplat.Distortion()(drawing).item() >= 0
        True
    """

    name = "distortion"
    outputs = ("distortion",)

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of one view."""
        assert drawing.rendering.distortion is not None
        return drawing.rendering.distortion.mean()
