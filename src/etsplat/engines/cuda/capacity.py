"""How many (triangle, tile) pairs the rasterizer makes room for on a GPU.

Buffers are sized before the number is known; the device counts, writes what fits and never beyond. Outside of graph
capture each call reads the count when it arrives and starts again with more room if it has to. In a captured graph
nothing can be read: the device keeps the largest count that did not fit in ``overflow_flag``, and who replays the graph
looks at it between replays:

    graph.replay()
    if repair_overflow(device):   # more room from now on
        ...                       # capture anew and repeat the step

Kernels of such a step that change parameters should do nothing while the flag is not 0.
"""

import torch
from torch import Tensor

from etsplat.engines.cuda.launch import backend

Shape = tuple[int, int, int]  # views, width, height

_FIRST_PER_TRIANGLE = 4
_FIRST_ROOM = 1 << 16
_SLACK = 1.25
_MOST = (1 << 30) - 1
_MOST_SUMMED = (1 << 25) - 1

_seen: dict[tuple[torch.device, Shape], tuple[int, int]] = {}  # -> (triangles, pairs they needed at most)
_overflow: dict[torch.device, Tensor] = {}
_captured: dict[torch.device, dict[Shape, int]] = {}  # -> triangles


def capacity_for(device: torch.device, shape: Shape, triangles: int) -> int:
    """Room for the pairs of ``triangles`` in each view, from what images of this shape needed before."""
    seen_triangles, pairs = _seen.get((device, shape), (triangles, 0))
    scale = max(1.0, triangles / max(seen_triangles, 1))
    guess = _FIRST_ROOM + _FIRST_PER_TRIANGLE * triangles * shape[0] if pairs == 0 else int(_SLACK * pairs * scale)
    return min(guess, _MOST)


def check_numbers(views: int, triangles: int, tiles: int) -> None:
    """Raise ValueError if the rasterizer cannot number what it draws.

    Args:
        views: Drawn together.
        triangles: In each view.
        tiles: In each view.
    """
    for what, each in (("triangles", triangles), ("tiles of pixels", tiles)):
        if views * each > _MOST:
            raise ValueError(
                f"rasterize: {views} views of {each} {what} are more than {_MOST}: render fewer views at a time"
            )


def check_summed(operation: str, pixels: int, values: int) -> None:
    """Raise ValueError if a sum of fixed-point numbers (csrc/cuda/fixed_sums.h) may overflow.

    Args:
        operation: For the message.
        pixels: In a view.
        values: That a pixel adds to one sum at most.
    """
    if pixels * values > _MOST_SUMMED:
        raise ValueError(
            f"{operation}: a view has {pixels} pixels, gradients are added up over {_MOST_SUMMED // values} at most:"
            " draw it in parts, or without gradients"
        )


def record_need(device: torch.device, shape: Shape, triangles: int, pairs: int) -> None:
    """Remember how many pairs a render needed.

    Raises:
        ValueError: They are more than the engine can number.
    """
    if pairs > _MOST:
        raise ValueError(f"rasterize: {pairs} (triangle, tile) pairs, at most {_MOST}: render fewer views or pixels")
    _, before = _seen.get((device, shape), (0, 0))
    _seen[device, shape] = (triangles, max(pairs, before))


def note_capture(device: torch.device, shape: Shape, triangles: int) -> None:
    """A render of this shape is part of a captured graph."""
    _captured.setdefault(device, {})[shape] = triangles


def overflow_flag(device: torch.device) -> Tensor:
    """(1,) int64 on the device: 0, or the largest number of pairs that did not fit since it was last repaired."""
    if device not in _overflow:
        if backend().capturing:
            raise RuntimeError("rasterize: render once before capturing a graph, so that kernels and buffers are ready")
        _overflow[device] = torch.zeros(1, dtype=torch.int64, device=device)
    return _overflow[device]


def repair_overflow(device: torch.device) -> bool:
    """Whether a render since the last call had too little room, which the next ones will have. Waits for the device."""
    flag = overflow_flag(device)
    wanted = int(flag.item())
    if wanted == 0:
        return False
    for shape, triangles in _captured.pop(device, {}).items():
        # What was captured before triangles multiplied may be gone: it must not look as if fewer needed so much.
        record_need(device, shape, max(triangles, _seen.get((device, shape), (0, 0))[0]), wanted)
    flag.zero_()
    return True
