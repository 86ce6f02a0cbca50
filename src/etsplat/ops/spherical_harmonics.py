"""View-dependent colour by real spherical harmonics up to degree 3, with the convention of 3D Gaussian splatting.

    color = max(0, 1/2 + sum_k Y_k(d / |d|) c_k)

with the bands l = 0..degree one after the other, m = -l..l within each, and the Condon-Shortley sign (Y_1 ~ -y, z, -x).
"""

from jaxtyping import Float
from torch import Tensor

from etsplat.core.harmonics import MAX_DEGREE
from etsplat.core.precision import as_given
from etsplat.core.validation import check_count, check_like, check_memory, check_shape
from etsplat.engines.choice import engine_for


@as_given
def spherical_harmonics(
    coefficients: Float[Tensor, "N K C"],
    directions: Float[Tensor, "N 3"] | Float[Tensor, "B N 3"],
    degree: int,
) -> Float[Tensor, "N C"] | Float[Tensor, "B N C"]:
    """Colours of N primitives as seen along ``directions``.

    Args:
        coefficients: (N, K, C) with K >= (degree + 1)^2; bands above ``degree`` are not used and get zero gradient.
        directions: (N, 3), or (B, N, 3) for B views: from the camera to the primitive, of any length. One of length
            1e-12 or less shows the constant band only and gets zero gradient.
        degree: 0 to 3.

    Returns:
        (N, C) or (B, N, C), at least 0. Gradients reach both tensors; there is none where the colour was clamped.

    Raises:
        ValueError: Wrong shape, dtype, device or degree; the message names the argument.

    Example:
        >>> coefficients = torch.zeros(1, 4, 3)  # degree 1; all zero is grey from everywhere
        >>> etsplat.spherical_harmonics(coefficients, torch.tensor([[0.0, 0.0, 1.0]]), degree=1).tolist()
        [[0.5, 0.5, 0.5]]
    """
    degree = check_count("degree", degree, least=0, most=MAX_DEGREE)
    check_shape("coefficients", coefficients, ("N", "K", "C"))
    if coefficients.shape[1] < (degree + 1) ** 2:
        raise ValueError(
            f"coefficients must have at least {(degree + 1) ** 2} bases for degree {degree}, "
            f"got shape {tuple(coefficients.shape)}"
        )
    check_memory("directions", directions)
    batch = ("B",) if directions.ndim == 3 else ()
    check_shape("directions", directions, (*batch, len(coefficients), 3))
    check_like("directions", directions, "coefficients", coefficients)
    return engine_for(coefficients).spherical_harmonics(coefficients, directions, degree)
