"""From the parameters of a soup to the opacities and the softness that are drawn.

    o = floor + (1 - floor) / (1 + exp(-logit))      sigma = min(0.01 + exp(raw), ceiling)

With a camera, o = 0 for triangles that are too small or too large there, as Triangle Splatting has it. And o = 0 for a
random share of the triangles, if there is to be dropout.
"""

import math

from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.soup_numbers import SoupNumbers
from etsplat.core.validation import check_like, check_shape
from etsplat.engines.choice import engine_for

PLAIN = SoupNumbers()
"""Nothing is squeezed, cut or left out by chance."""


def soup_activation(
    vertices: Float[Tensor, "N 3 3"],
    opacity_logits: Float[Tensor, " N"],
    sigma_raw: Float[Tensor, " N"],
    numbers: SoupNumbers | Float[Tensor, "4"] = PLAIN,
    camera: Cameras | None = None,
    *,
    smallest: float = 0.0,
    largest: float = math.inf,
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """Opacities and sigma as they are drawn, differentiable with respect to the logits and ``sigma_raw``.

    Args:
        vertices: (N, 3, 3) corners in world space; only looked at for ``camera``.
        opacity_logits: (N,).
        sigma_raw: (N,).
        numbers: Floor, ceiling and dropout, which is by a triangle's row; as a tensor in queued steps.
        camera: One camera, for whose image triangles are left out by their size; None keeps them.
        smallest: In pixels: triangles with a smaller inradius are left out.
        largest: In pixels: so are those where a vertex is farther from the mean of the projected vertices.

    Returns:
        (N,) opacities, 0 for those that are left out, and (N,) sigma.

    Raises:
        ValueError: Wrong shape, dtype or device; more than one camera.
    """
    N = len(vertices)
    if not isinstance(numbers, Tensor):
        numbers = SoupNumbers(*numbers)
    check_shape("vertices", vertices, ("N", 3, 3))
    for name, tensor in (("opacity_logits", opacity_logits), ("sigma_raw", sigma_raw)):
        check_shape(name, tensor, (N,))
        check_like(name, tensor, "vertices", vertices)
    if camera is not None and len(camera) != 1:
        raise ValueError(f"camera must be one where triangles are left out, got {len(camera)}")
    return engine_for(vertices).soup_activation(
        vertices.detach(), opacity_logits, sigma_raw, numbers, camera, smallest, largest
    )
