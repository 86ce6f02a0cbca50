"""Differentiable triangle splatting (paper, section "Triangle Splatting"): the public call and its checks."""

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.backgrounds import for_each_view
from etsplat.core.cameras import Cameras, view_arguments
from etsplat.core.kernels import DISTANCES, KERNELS, kernel_name
from etsplat.core.precision import as_given
from etsplat.core.rasterization import (
    DEFAULT_CUTOFFS,
    DEPTHS,
    OUTPUTS,
    Cutoffs,
    Rasterization,
    RasterizeSettings,
    RasterizeTensors,
    names_of,
)
from etsplat.core.validation import (
    Shape,
    check_above,
    check_choice,
    check_device,
    check_finite,
    check_flags,
    check_floating,
    check_indices,
    check_integers,
    check_intrinsics,
    check_kind,
    check_last_rows,
    check_like,
    check_number,
    check_positive,
    check_shape,
)
from etsplat.engines.choice import engine_for

COLORS = ("face_colors", "vertex_colors", "corner_colors")
OPTIONAL = (*COLORS, "backgrounds")
_SEPARATE, _SHARED = ("N", 3, 3), ("V", 3)
_SHAPES: dict[str, tuple[Shape, ...]] = {
    "opacities": (("N",),),
    "sigma": ((), ("N",)),
    "viewmats": (("B", 4, 4),),
    "Ks": (("B", 3, 3),),
    "face_colors": (("N", "C"), ("B", "N", "C")),
    "vertex_colors": (("V", "C"),),
    "corner_colors": (("N", 3, "C"),),
    "backgrounds": (("C",), ("B", "C")),
}
LARGEST_COLOR = 1e30  # beyond, the gradients of the triangles around overflow


@as_given
def rasterize(
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "N 3 3"],
    *,
    opacities: Float[Tensor, " N"],
    sigma: Float[Tensor, ""] | Float[Tensor, " N"] | float,
    face_colors: Float[Tensor, "N C"] | Float[Tensor, "B N C"] | None = None,
    vertex_colors: Float[Tensor, "V C"] | None = None,
    corner_colors: Float[Tensor, "N 3 C"] | None = None,
    viewmats: Float[Tensor, "B 4 4"] | None = None,
    Ks: Float[Tensor, "B 3 3"] | None = None,
    width: int | None = None,
    height: int | None = None,
    cameras: Cameras | None = None,
    faces: Int[Tensor, "N 3"] | None = None,
    backgrounds: Float[Tensor, " C"] | Float[Tensor, "B C"] | None = None,
    kernel: str = "elastic",
    distance: str = "barycentric",
    outputs: Sequence[str] = ("color",),
    depth_of: Literal["plane", "centroid"] = "plane",
    near_plane: float = 0.01,
    freeze_inradius: bool = False,
    cutoffs: Cutoffs = DEFAULT_CUTOFFS,
    validate: bool | None = None,
) -> Rasterization:
    """Splat N soft triangles into B images.

    A pixel at normalised distance x from a triangle (0 at its centre, 1 on its edge) sees it with alpha = min(0.99,
    o G(x)). Triangles are composited front to back in the order of the view-space z of their centroid, ties by index:
    C = sum_i w_i c_i + T background with w_i = alpha_i prod_{j<i} (1 - alpha_j). docs/conventions.md has axes, culls
    and cut-offs; docs/method.md has the formulas. Gradients reach vertices, colours, opacities, sigma, backgrounds,
    viewmats and Ks. All floating-point tensors share one dtype and device.

    Args:
        vertices: (V, 3) with ``faces``, or (N, 3, 3) corners of separate triangles; world space.
        opacities: (N,) in [0, 1].
        sigma: Softness > 0, small is sharp: () or (N,).
        face_colors: (N, C) or, per view, (B, N, C): one colour per triangle, any number C >= 1 of channels. Exactly one
            of the three colours is given.
        vertex_colors: (V, C), with ``faces``: interpolated over the triangles, perspective-correct.
        corner_colors: (N, 3, C): the same with a colour of its own for each corner.
        viewmats: (B, 4, 4) world to camera, OpenCV axes (x right, y down, z forward).
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, pixel centres at half-integers.
        width: Image width in pixels.
        height: Image height in pixels.
        cameras: All of the four above in one.
        faces: (N, 3) int32 or int64 indices into ``vertices``.
        backgrounds: (C,) behind all views, or (B, C); None is black.
        kernel: "elastic", "bilateral", "single_sided", "hard", or a name given to ``register_kernel``.
        distance: "barycentric" (about the mean of the projected vertices) or "sdf" (about the incentre).
        outputs: What is wanted besides colour and alpha, which are always there: "depth", "median_depth", "normal",
            "distortion", "statistics".
        depth_of: z of a pixel, of all three kinds of depth: on the triangle's "plane", or of its "centroid".
        near_plane: Triangles with a vertex at z <= near_plane are invisible; > 0.
        freeze_inradius: With distance "sdf", hold the inradius constant in the backward pass, as Triangle Splatting.
        cutoffs: Where compositing stops caring.
        validate: Raise on non-finite input, sigma <= 0, malformed Ks, transposed viewmats, and colours beyond 1e30,
            whose products in the gradients overflow; None means on the CPU. Without it a triangle with data that is not
            finite, or on a GPU with a wrong index in ``faces``, is invisible and gets zero gradient.

    Returns:
        Images, channels last, in the dtype of ``vertices``; see ``Rasterization``.

    Raises:
        ValueError: An argument has the wrong shape, dtype, device or range; the message names it.

    Example:
        One triangle seen from the origin, and how the red of the picture pulls at its corners:

        >>> corners = torch.tensor([[[-0.5, -0.5, 2.0], [0.5, -0.5, 2.0], [0.0, 0.5, 2.0]]], requires_grad=True)
        >>> cameras = etsplat.Cameras(torch.eye(4)[None], etsplat.intrinsics(60.0, 32, 24)[None], 32, 24)
        >>> one = torch.ones(1)
        >>> out = etsplat.rasterize(corners, opacities=one, sigma=0.5, face_colors=torch.eye(3)[:1], cameras=cameras)
        >>> out.color.shape, out.alpha.shape
        (torch.Size([1, 24, 32, 3]), torch.Size([1, 24, 32, 1]))
        >>> out.color[..., 0].mean().backward()
        >>> corners.grad.shape
        torch.Size([1, 3, 3])
    """
    viewmats, Ks, width, height = view_arguments(cameras, viewmats, Ks, width, height)
    settings = RasterizeSettings(
        width=width,
        height=height,
        kernel=kernel_name(kernel),
        distance=distance,
        outputs=names_of(outputs),
        depth_of=depth_of,
        near_plane=near_plane,
        freeze_inradius=freeze_inradius,
        cutoffs=cutoffs,
    )
    _check_settings(settings)
    _check_vertices(vertices, faces)
    tensors = RasterizeTensors(
        vertices=vertices,
        opacities=opacities,
        sigma=sigma if isinstance(sigma, Tensor) else _filled(sigma, vertices),
        viewmats=viewmats,
        Ks=Ks,
        faces=faces,
        face_colors=face_colors,
        vertex_colors=vertex_colors,
        corner_colors=corner_colors,
        backgrounds=for_each_view(backgrounds, len(viewmats)),
    )
    # Looking at values on a GPU would mean to wait for it.
    look = validate or (validate is None and vertices.is_cpu)
    named = tensors._asdict()
    left_out = {"faces", *(name for name in OPTIONAL if named[name] is None)}
    given = {name: tensor for name, tensor in named.items() if name not in left_out}
    _check_tensors(given, faces, look)
    if look:
        _check_values(given)
    return engine_for(vertices).rasterize(tensors, settings)


def one_kind_of_colors(
    face_colors: Tensor | None, vertex_colors: Tensor | None, corner_colors: Tensor | None, faces: Tensor | None
) -> tuple[str, Tensor]:
    """The colours that are given, with their name.

    Raises:
        ValueError: Not exactly one kind is given, or those of vertices without faces.
    """
    kinds = zip(COLORS, (face_colors, vertex_colors, corner_colors), strict=True)
    given = [(name, colors) for name, colors in kinds if colors is not None]
    if len(given) != 1:
        names = " and ".join(name for name, _ in given) or "none"
        raise ValueError(f"exactly one of {', '.join(COLORS)} must be given, got {names}")
    if vertex_colors is not None and faces is None:
        raise ValueError("vertex_colors need faces; separate triangles have corner_colors (N, 3, C)")
    return given[0]


def _check_vertices(vertices: Tensor, faces: Tensor | None) -> None:
    """Before the others, which are compared with them."""
    if faces is None and isinstance(vertices, Tensor) and vertices.ndim == 2:
        got = tuple(vertices.shape)
        raise ValueError(f"vertices must have shape (N, 3, 3) where faces is None, got {got}: pass faces= too")
    check_shape("vertices", vertices, _SEPARATE if faces is None else _SHARED)
    check_floating("vertices", vertices)
    if vertices.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"vertices must be float32 or float64, got {vertices.dtype}")


def _filled(number: Any, like: Tensor) -> Any:
    """A number as a tensor (); anything else as it is."""
    if isinstance(number, Real | np.ndarray) and np.ndim(number) == 0 and not isinstance(number, bool):  # pyright: ignore[reportArgumentType]
        return torch.full((), float(number), dtype=like.dtype, device=like.device)
    return number


def _check_settings(settings: RasterizeSettings) -> None:
    check_flags(freeze_inradius=settings.freeze_inradius)
    check_choice("kernel", settings.kernel, list(KERNELS))
    check_choice("distance", settings.distance, DISTANCES)
    check_choice("depth_of", settings.depth_of, DEPTHS)
    for name in sorted(settings.outputs, key=str):
        check_choice("outputs", name, OUTPUTS)
    check_above("near_plane", settings.near_plane)
    check_kind("cutoffs", settings.cutoffs, Cutoffs, "pass etsplat.Cutoffs(), with what is to differ")
    for name, number in settings.cutoffs._asdict().items():
        check_number(f"cutoffs.{name}", number)
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
    face_colors, vertex_colors, corner_colors = map(given.get, COLORS)
    colors, _ = one_kind_of_colors(face_colors, vertex_colors, corner_colors, faces)
    sizes: dict[str, int] = {}
    if faces is not None:
        check_shape("faces", faces, ("N", 3), sizes=sizes)
    for name, tensor in given.items():
        if name == "vertices":
            check_shape(name, tensor, _SEPARATE if faces is None else _SHARED, sizes=sizes)
        else:
            check_shape(name, tensor, *_SHAPES[name], sizes=sizes)
            check_like(name, tensor, "vertices", given["vertices"])
    if sizes["B"] < 1:
        raise ValueError("viewmats must hold at least one camera, got 0")
    if sizes["C"] < 1:
        raise ValueError(f"{colors} must have at least one channel, got 0")
    if faces is not None:
        check_device("faces", faces, "vertices", given["vertices"])
        check_integers("faces", faces)
        if look or faces.is_cpu:
            check_indices("faces", faces, sizes["V"])


def _check_values(given: dict[str, Tensor]) -> None:
    for name, tensor in given.items():
        check_finite(name, tensor, LARGEST_COLOR if name in (*COLORS, "backgrounds") else math.inf)
    check_positive("sigma", given["sigma"])
    check_intrinsics("Ks", given["Ks"])
    check_last_rows("viewmats", given["viewmats"])
