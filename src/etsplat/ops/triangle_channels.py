"""What depth and normal images are made of: the depth of each triangle's centroid, and its normal turned to the camera.

z = (R (v0 + v1 + v2) / 3 + t)_z      n = +- normalize((v1 - v0) x (v2 - v0)),  n . (centroid - camera) <= 0
"""

from jaxtyping import Float
from torch import Tensor

from etsplat.core.precision import as_given
from etsplat.core.validation import check_flags, check_like, check_shape
from etsplat.engines.choice import engine_for


@as_given
def triangle_channels(
    corners: Float[Tensor, "N 3 3"],
    viewmats: Float[Tensor, "B 4 4"],
    *,
    depth: bool,
    normals: bool,
) -> Float[Tensor, "B N D"]:
    """Depths of centroids, then normals, those that are wanted; differentiable.

    Args:
        corners: (N, 3, 3) in world space. A triangle that is not finite gets zeros and no gradient.
        viewmats: (B, 4, 4) world to camera; one that is not finite counts as zeros.
        depth: whether the first channel is the view-space z of the centroid.
        normals: whether the last three are the unit normal in world space, 0 for a triangle without area.

    Returns:
        (B, N, D), D from 1 to 4. Gradients reach corners, and through the depth viewmats.

    Raises:
        ValueError: Wrong shape, dtype or device, or nothing is wanted; the message names the argument.
    """
    check_shape("corners", corners, ("N", 3, 3))
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_like("viewmats", viewmats, "corners", corners)
    check_flags(depth=depth, normals=normals)
    if not (depth or normals):
        raise ValueError("depth and normals must not both be False")
    return engine_for(corners).triangle_channels(corners, viewmats, depth, normals)
