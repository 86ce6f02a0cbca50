"""Do the normals of the triangles agree with those of the depth image (2D Gaussian splatting's normal loss)?

    L_n = mean (1 - <n, A m>),    m = normalize(d_rows P x d_columns P)

over all pixels, with n the blended normals, A the coverage (held constant) and P the points of the depth image in the
world, differentiated centrally. On the border of one pixel, and where the points do not span a plane, m is 0.
"""

from jaxtyping import Float
from torch import Tensor

from etsplat.core.precision import as_given
from etsplat.core.validation import check_like, check_shape
from etsplat.engines.choice import engine_for


@as_given
def normal_consistency(
    normals: Float[Tensor, "B H W 3"],
    depth: Float[Tensor, "B H W 1"],
    alpha: Float[Tensor, "B H W 1"],
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
) -> Float[Tensor, ""]:
    """Mean disagreement of two kinds of normals.

    Args:
        normals: (B, H, W, 3) in world space, turned to the camera, not renormalised.
        depth: (B, H, W, 1) z of the surface, for instance the median depth.
        alpha: (B, H, W, 1) coverage; receives no gradient.
        viewmats: (B, 4, 4) world to camera.
        Ks: (B, 3, 3) intrinsics.

    Returns:
        Scalar; gradients reach normals and depth. The native engines add in a fixed order: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device; an empty image.

    Example:
        >>> camera = etsplat.orbit_cameras(16, 16)[0]
        >>> vertices, faces = etsplat.icosphere(3)
        >>> look = dict(vertex_colors=0 * vertices, opacities=torch.ones(len(faces)), sigma=0.1)
        >>> drawn = etsplat.rasterize(vertices, faces=faces, cameras=camera, outputs=("median_depth", "normal"), **look)
        >>> loss = etsplat.normal_consistency(drawn.normal, drawn.median_depth, drawn.alpha, camera.viewmats, camera.Ks)
        >>> bool(0 < loss < 1)
        True
    """
    check_shape("normals", normals, ("B", "H", "W", 3))
    image = tuple(normals.shape[:3])
    for name, tensor, shape in (
        ("depth", depth, (*image, 1)),
        ("alpha", alpha, (*image, 1)),
        ("viewmats", viewmats, (image[0], 4, 4)),
        ("Ks", Ks, (image[0], 3, 3)),
    ):
        check_shape(name, tensor, shape)
        check_like(name, tensor, "normals", normals)
    if normals.numel() == 0:
        raise ValueError(f"normals must hold at least one pixel, got shape {tuple(normals.shape)}")
    return engine_for(normals).normal_consistency(normals, depth, *(t.detach() for t in (alpha, viewmats, Ks)))
