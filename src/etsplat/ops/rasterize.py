"""Differentiable triangle splatting (paper, section "Triangle Splatting"): the public call and its checks."""

import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.rasterization import DEFAULT_CUTOFFS, Cutoffs, Rasterization, RasterizeSettings
from etsplat.core.validation import (
    Shape,
    check_choice,
    check_device,
    check_finite,
    check_indices,
    check_intrinsics,
    check_like,
    check_positive,
    check_shape,
)
from etsplat.engines.choice import engine_for

_COLORS = ("colors", "corner_colors", "backgrounds")
_LARGEST_COLOR = 1e30  # beyond, the gradients of the triangles around overflow


def rasterize(
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "N 3 3"],
    colors: Float[Tensor, "N C"] | Float[Tensor, "B N C"] | None,
    opacities: Float[Tensor, " N"],
    sigma: Float[Tensor, ""] | Float[Tensor, " N"] | float,
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
    width: int,
    height: int,
    *,
    faces: Int[Tensor, "N 3"] | None = None,
    corner_colors: Float[Tensor, "N 3 C"] | Float[Tensor, "V C"] | None = None,
    kernel: str = "elastic",
    distance: str = "barycentric",
    backgrounds: Float[Tensor, "B C"] | None = None,
    depth: Literal["plane", "centroid"] | None = None,
    median_depth: bool = False,
    normals: bool = False,
    distortion: bool = False,
    statistics: bool = False,
    near_plane: float = 0.01,
    freeze_incentre: bool = False,
    cutoffs: Cutoffs = DEFAULT_CUTOFFS,
    validate: bool | None = None,
) -> Rasterization:
    """Splat N soft triangles into B images.

    A pixel at normalised distance x from a triangle (0 at its centre, 1 on its edge) sees it with alpha = min(0.99,
    o G(x)). Triangles are composited front to back in the order of the view-space z of their centroid, ties by index:
    C = sum_i w_i c_i + T background with w_i = alpha_i prod_{j<i} (1 - alpha_j). docs/conventions.md has axes, culls
    and cut-offs; docs/method.md has the formulas. Gradients reach vertices, colours, opacities, sigma, backgrounds,
    viewmats, and of Ks the focal lengths and principal point. All floating-point tensors share one dtype and device.

    Args:
        vertices: (V, 3) with ``faces``, or (N, 3, 3) corners of separate triangles; world space.
        colors: (N, C) or, per view, (B, N, C): one colour per triangle, any number C >= 1 of channels. None if
            ``corner_colors`` is given.
        opacities: (N,) in [0, 1].
        sigma: Softness > 0, small is sharp: () or (N,).
        viewmats: (B, 4, 4) world to camera, OpenCV axes (x right, y down, z forward).
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, pixel centres at half-integers.
        width: Image width in pixels.
        height: Image height in pixels.
        faces: (N, 3) int32 or int64 indices into ``vertices``.
        corner_colors: (N, 3, C), or (V, C) with ``faces``: colours interpolated over the triangle, perspective-correct.
        kernel: "elastic", "bilateral", "single_sided", "hard", or a name given to ``register_kernel``.
        distance: "barycentric" (about the mean of the projected vertices) or "sdf" (about the incentre).
        backgrounds: (B, C); None is black.
        depth: z of a pixel on the triangle's "plane", or of the triangle's "centroid"; None for no depth image. Median
            depth and distortion use the same z, on the plane if None.
        median_depth: Also return the median depth.
        normals: Also return normals.
        distortion: Also return the distortion.
        statistics: Also return per-triangle statistics.
        near_plane: Triangles with a vertex at z <= near_plane are invisible; > 0.
        freeze_incentre: With distance "sdf", hold the inradius constant in the backward pass, as Triangle Splatting.
        cutoffs: Where compositing stops caring.
        validate: Raise on non-finite input, sigma <= 0, malformed Ks, and colours beyond 1e30, whose products in the
            gradients overflow; None means on the CPU. Without it a triangle with data that is not finite, or on a GPU
            with a wrong index in ``faces``, is invisible and gets zero gradient.

    Returns:
        Images, channels last, in the dtype of ``vertices``; see ``Rasterization``.

    Raises:
        ValueError: An argument has the wrong shape, dtype, device or range; the message names it.
    """
    if not isinstance(sigma, Tensor):
        sigma = torch.full((), float(sigma), dtype=vertices.dtype, device=vertices.device)
    settings = RasterizeSettings(
        width=width,
        height=height,
        kernel=kernel,
        distance=distance,
        near_plane=near_plane,
        freeze_incentre=freeze_incentre,
        depth=depth or "none",
        median_depth=median_depth,
        normals=normals,
        distortion=distortion,
        statistics=statistics,
        cutoffs=cutoffs,
    )
    _check_settings(settings)
    floats = {
        "vertices": vertices,
        "colors": colors,
        "corner_colors": corner_colors,
        "opacities": opacities,
        "sigma": sigma,
        "viewmats": viewmats,
        "Ks": Ks,
        "backgrounds": backgrounds,
    }
    given = {name: tensor for name, tensor in floats.items() if tensor is not None}
    # Looking at values on a GPU would mean to wait for it.
    look = validate or (validate is None and vertices.is_cpu)
    _check_tensors(given, faces, look)
    if look:
        _check_values(given)
    return engine_for(vertices).rasterize(
        vertices, faces, colors, corner_colors, opacities, sigma, viewmats, Ks, backgrounds, settings
    )


def _check_settings(settings: RasterizeSettings) -> None:
    for name, size in (("width", settings.width), ("height", settings.height)):
        if not isinstance(size, int) or size < 1:
            raise ValueError(f"{name} must be a positive integer, got {size!r}")
    check_choice("kernel", settings.kernel, list(KERNELS))
    check_choice("distance", settings.distance, DISTANCES)
    check_choice("depth", None if settings.depth == "none" else settings.depth, (None, "plane", "centroid"))
    if not 0.0 < settings.near_plane < float("inf"):
        raise ValueError(f"near_plane must be positive and finite, got {settings.near_plane}")
    alpha_min, alpha_max, x_max, transmittance_min = settings.cutoffs
    if not (0.0 <= alpha_min < alpha_max <= 1.0 and x_max > 0.0 and 0.0 <= transmittance_min < 1.0):
        raise ValueError(
            "cutoffs must satisfy 0 <= alpha_min < alpha_max <= 1, x_max > 0 and 0 <= transmittance_min < 1, "
            f"got {settings.cutoffs}"
        )
    table = KERNELS[settings.kernel].table
    if table is not None and x_max > table.x_max:
        raise ValueError(
            f"cutoffs.x_max must be at most {table.x_max} with kernel {settings.kernel!r}, as it was registered, "
            f"got {x_max}"
        )


def _check_tensors(given: dict[str, Tensor], faces: Tensor | None, look: bool) -> None:
    if ("colors" in given) == ("corner_colors" in given):
        got = "both" if "colors" in given else "neither"
        raise ValueError(f"exactly one of colors and corner_colors must be given, got {got}")
    sizes: dict[str, int] = {}
    if faces is not None:
        check_shape("faces", faces, ("N", 3), sizes=sizes)
    shapes: dict[str, list[Shape]] = {
        "vertices": [("N", 3, 3)] if faces is None else [("V", 3)],
        "opacities": [("N",)],
        "sigma": [(), ("N",)],
        "viewmats": [("B", 4, 4)],
        "Ks": [("B", 3, 3)],
        "colors": [("N", "C"), ("B", "N", "C")],
        "corner_colors": [("N", 3, "C")] if faces is None else [("V", "C"), ("N", 3, "C")],
        "backgrounds": [("B", "C")],
    }
    for name, alternatives in shapes.items():
        if name in given:
            check_shape(name, given[name], *alternatives, sizes=sizes)
            check_like(name, given[name], "vertices", given["vertices"])
    if sizes["B"] < 1:
        raise ValueError("viewmats must hold at least one camera, got 0")
    if sizes["C"] < 1:
        raise ValueError("colors must have at least one channel, got 0")
    if faces is not None:
        check_device("faces", faces, "vertices", given["vertices"])
        if look or faces.is_cpu:
            check_indices("faces", faces, sizes["V"])


def _check_values(given: dict[str, Tensor]) -> None:
    for name, tensor in given.items():
        check_finite(name, tensor, _LARGEST_COLOR if name in _COLORS else math.inf)
    check_positive("sigma", given["sigma"])
    check_intrinsics("Ks", given["Ks"])
