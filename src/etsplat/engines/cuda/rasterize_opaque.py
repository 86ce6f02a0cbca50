"""The GPU engine's side of `rasterize_opaque` and `render_opaque`: csrc/cuda/rasterize_opaque.cu."""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from etsplat.core.rasterization import OpaqueView
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import constant, struct_class

_PROGRAM = Program("rasterize_opaque.cu", contract=False)
_THREADS = constant("cuda/rasterize_opaque.cu", "kThreads")
# Samples of a strip: 16 MiB of z-buffer, which the L2 cache of most devices holds.
_STRIP_SAMPLES = 1 << 21


def rasterize_opaque(
    points: Tensor, triangles: Tensor, view: OpaqueView, triangle: Tensor, barycentrics: Tensor, depth: Tensor
) -> None:
    """See `Engine.rasterize_opaque`."""
    problem = _problem(points, triangles, view, 1, False)
    for top, bottom, buffer in _drawn_strips(problem, points):
        arguments = (problem, top, bottom, buffer, triangle, barycentrics, depth)
        launch(_PROGRAM, "opaque_resolve", blocks((bottom - top) * view.width, _THREADS), _THREADS, arguments)


def render_opaque(
    points: Tensor,
    triangles: Tensor,
    view: OpaqueView,
    colors: Tensor,
    per_face: bool,
    supersampling: int,
    cull_backfaces: bool,
    image: Tensor,
) -> None:
    """See `Engine.render_opaque`."""
    problem = _problem(points, triangles, view, supersampling, cull_backfaces)
    for top, bottom, buffer in _drawn_strips(problem, points):
        arguments = (problem, top, bottom, buffer, colors, int(per_face), colors.shape[1], image)
        pixels = (bottom - top) // supersampling * view.width
        launch(_PROGRAM, "opaque_shade", blocks(pixels, _THREADS), _THREADS, arguments)


def _problem(points: Tensor, triangles: Tensor, view: OpaqueView, samples: int, cull_backfaces: bool) -> Any:
    tensors = points, triangles, view.viewmat, view.K
    sizes = len(points), len(triangles), view.width * samples, view.height * samples, samples
    return struct_class("cuda/rasterize_opaque.cu", "OpaqueView")(*tensors, *sizes, view.near_plane, cull_backfaces)


def _drawn_strips(problem: Any, points: Tensor) -> Iterator[tuple[int, int, Tensor]]:
    """First row of samples of each strip, the one after its last, and the buffer into which it was drawn.

    Whoever resolves a strip leaves zeros in the buffer, for the next.
    """
    faces = blocks(problem.num_faces, _THREADS)
    rows = torch.empty((problem.num_faces, 2), dtype=torch.int32, device=points.device)
    launch(_PROGRAM, "opaque_rows", faces, _THREADS, (problem, rows))
    per_strip = problem.samples * max(1, _STRIP_SAMPLES // (problem.width * problem.samples))
    buffer = torch.zeros((min(per_strip, problem.height), problem.width), dtype=torch.int64, device=points.device)
    for top in range(0, problem.height, per_strip):
        bottom = min(top + per_strip, problem.height)
        launch(_PROGRAM, "opaque_draw", faces, _THREADS, (problem, rows, top, bottom, buffer))
        yield top, bottom, buffer
