"""What is minimised in novel-view synthesis: the paper's L_nvs."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float, UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import Rasterization
from etsplat.ops.normal_consistency import normal_consistency
from etsplat.ops.photometric import photometric_loss
from etsplat.ops.triangle_area import mean_area
from etsplat.ops.weighted_sum import Term, weighted_sum


@dataclass(frozen=True)
class SoupWeights:
    """Weights in L_nvs at one iteration; a term of weight 0 is not computed.

    Attributes:
        dssim: share of 1 - SSIM in the photometric term.
        opacity: of the mean opacity.
        size: of the reciprocal of the mean area.
        normal: of the disagreement of normals.
        distortion: of the mean distortion.
        pixel: "l1", or "l2" as Triangle Splatting has it for very large outdoor scenes.
    """

    dssim: float
    opacity: float
    size: float
    normal: float
    distortion: float
    pixel: Literal["l1", "l2"] = "l1"


def soup_objective(
    rendering: Rasterization,
    target: UInt8[Tensor, "1 H W C"],
    mask: Float[Tensor, "1 H W"] | None,
    background: Float[Tensor, "1 3"],
    vertices: Float[Tensor, "N 3 3"],
    opacities: Float[Tensor, " N"],
    camera: Cameras,
    weights: SoupWeights,
) -> Float[Tensor, ""]:
    """The training objective of novel-view synthesis (paper section 3.4, L_nvs).

    L_nvs = (1 - l) L_1 + l (1 - SSIM) + lambda_o mean o + lambda_s / mean area + lambda_n L_n + lambda_d mean D

    Args:
        rendering: of one view over `background`, with normals and median depth where `weights.normal` is positive, and
            distortion where `weights.distortion` is.
        target: (1, H, W, 3 or 4) bytes.
        mask: (1, H, W) in [0, 1], or None.
        background: (1, 3).
        vertices: (N, 3, 3) of the soup.
        opacities: (N,) of the soup.
        camera: of the view.
        weights: of the terms.

    Returns:
        Scalar, differentiable with respect to the rendering, the vertices and the opacities.
    """
    photometric = photometric_loss(
        rendering.color, target, weights.dssim, mask, backgrounds=background, pixel=weights.pixel
    )
    terms = []
    if weights.opacity > 0:
        terms.append(Term(weights.opacity, opacities.mean()))
    if weights.size > 0:
        terms.append(Term(weights.size, mean_area(vertices), -1))
    if weights.normal > 0:
        assert rendering.normal is not None
        assert rendering.median_depth is not None
        disagreement = normal_consistency(
            rendering.normal,
            rendering.median_depth,
            rendering.alpha.detach(),
            camera.viewmats,
            camera.Ks,
        )
        terms.append(Term(weights.normal, disagreement))
    if weights.distortion > 0:
        assert rendering.distortion is not None
        terms.append(Term(weights.distortion, rendering.distortion.mean()))
    return weighted_sum(photometric, terms)
