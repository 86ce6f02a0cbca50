"""The mean area of separate triangles, for the size loss of novel-view synthesis."""

from jaxtyping import Float
from torch import Tensor

from etsplat.core.precision import as_given
from etsplat.core.validation import check_shape
from etsplat.engines.choice import engine_for


@as_given
def mean_area(vertices: Float[Tensor, "N 3 3"]) -> Float[Tensor, ""]:
    """Mean of |(v1 - v0) x (v2 - v0)| / 2.

    Args:
        vertices: (N, 3, 3), N > 0. A triangle without area gets no gradient.

    Returns:
        Scalar. The native engines add in a fixed order: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device; no triangle.
    """
    check_shape("vertices", vertices, ("N", 3, 3))
    if len(vertices) == 0:
        raise ValueError("vertices must hold at least one triangle, got 0")
    return engine_for(vertices).mean_area(vertices)
