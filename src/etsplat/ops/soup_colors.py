"""Colours of a triangle soup as cameras see it: spherical harmonics along the line of sight to each centroid."""

from jaxtyping import Float
from torch import Tensor

from etsplat.core.harmonics import MAX_DEGREE, MAX_REST
from etsplat.core.precision import as_given
from etsplat.core.validation import check_like, check_shape
from etsplat.engines.choice import engine_for


@as_given
def soup_colors(
    vertices: Float[Tensor, "N 3 3"],
    sh_dc: Float[Tensor, "N 1 3"],
    sh_rest: Float[Tensor, "N R 3"],
    centers: Float[Tensor, "B 3"],
    degree: int,
) -> Float[Tensor, "B N 3"]:
    """Evaluates max(0, 1/2 + sum_k Y_k(d) c_k), d from the camera to the mean of the triangle's corners.

    Args:
        vertices: (N, 3, 3) corners in world space.
        sh_dc: (N, 1, 3) coefficient of the constant band.
        sh_rest: (N, R, 3) those of the other bands, R >= (degree + 1)^2 - 1; bands above ``degree`` get zero gradient.
        centers: (B, 3) camera positions; they receive no gradient.
        degree: 0 to 3.

    Returns:
        (B, N, 3), at least 0. Gradients reach the first three tensors; there is none where the colour was clamped.

    Raises:
        ValueError: Wrong shape, dtype, device or degree; the message names the argument.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be from 0 to {MAX_DEGREE}, got {degree}")
    N = len(vertices)
    check_shape("vertices", vertices, ("N", 3, 3))
    check_shape("sh_dc", sh_dc, (N, 1, 3))
    check_shape("sh_rest", sh_rest, (N, "R", 3))
    check_shape("centers", centers, ("B", 3))
    for name, tensor in (("sh_dc", sh_dc), ("sh_rest", sh_rest), ("centers", centers)):
        check_like(name, tensor, "vertices", vertices)
    if sh_rest.shape[1] < (degree + 1) ** 2 - 1:
        raise ValueError(f"sh_rest must have {(degree + 1) ** 2 - 1} bases for degree {degree}, got {sh_rest.shape[1]}")
    return engine_for(vertices).soup_colors(vertices, sh_dc, sh_rest[:, :MAX_REST], centers.detach(), degree)
