"""Comparison of a native rasterizer with the float64 reference."""

import torch

from etsplat.ops.rasterize import COLORS
from helpers.scenes import IMAGES, gradients
from helpers.tolerances import assert_close_to_scale

# Rounding, and pixels that float32 decides differently at alpha = 1/255, at x = 2 or between almost equal depths.
IMAGE_TOLERANCE = {"tolerance": 2e-5, "outliers": 2e-3, "outlier_tolerance": 2e-2}
GRADIENT_TOLERANCE = {"tolerance": 2e-4, "outliers": 5e-3, "outlier_tolerance": 1e-3}
# The gradient of x grows as the triangle gets thinner, and with it the scale and the rounding.
GEOMETRY_TOLERANCE = {"tolerance": 5e-4, "outliers": 5e-3, "outlier_tolerance": 5e-3}


# One sigma for all: a sum over all triangles of terms of both signs.
SHARED_SIGMA_TOLERANCE = {"tolerance": 5e-3}


def gradient_tolerance(name, expected, looseness=1.0):
    if name == "sigma" and expected.ndim == 0:
        chosen = SHARED_SIGMA_TOLERANCE
    else:
        chosen = GEOMETRY_TOLERANCE if name in ("vertices", "viewmats", "Ks") else GRADIENT_TOLERANCE
    return {key: value if key == "outliers" else looseness * value for key, value in chosen.items()}


def compare(scene, engine, rng, images=IMAGES, looseness=1.0, **options):
    """Same images, statistics and gradients under random cotangents as the oracle has."""
    if options.get("kernel") == "single_sided":
        # Below 1 its slope at the edge is unbounded, and rounding decides the gradient of a pixel there.
        scene = {**scene, "sigma": scene["sigma"] + 1.0}
    shape = (len(scene["viewmats"]), scene["height"], scene["width"])
    colors = next(scene[name] for name in COLORS if name in scene)
    widths = {"color": colors.shape[-1], "normal": 3}
    cotangents = {name: torch.randn(*shape, widths.get(name, 1), generator=rng) for name in images}
    dtype = torch.float32
    out, grads = gradients(scene, engine, cotangents, dtype, **options)
    oracle, oracle_grads = gradients(scene, "reference", cotangents, torch.float64, **options)
    for name in images:
        assert_close_to_scale(getattr(out, name), getattr(oracle, name), **IMAGE_TOLERANCE, name=name)
    for name, expected in oracle_grads.items():
        assert_close_to_scale(
            grads[name], expected, **gradient_tolerance(name, expected, looseness), name=f"gradient of {name}"
        )
    if "statistics" in options.get("outputs", ()):
        assert (out.statistics.visible.cpu() != oracle.statistics.visible).sum() <= 1
        for name in ("max_weight", "screen_size", "inradius"):
            actual, expected = getattr(out.statistics, name), getattr(oracle.statistics, name)
            assert_close_to_scale(actual, expected, 1e-4, outliers=0.01, outlier_tolerance=0.1, name=name)
