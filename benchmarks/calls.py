"""What Python and autograd around native code cost: forward and backward of 20 triangles at 16 x 16.

python -m benchmarks.calls      microseconds of one thread: again and again, and after a picture of sphere4 each time

A picture sweeps the caches; a call then finds neither Python's nor torch's code there. Beside it stands a function of
autograd with as many inputs that does nothing.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch

import etsplat
from benchmarks import scenes
from etsplat import _native
from etsplat.geometry.icosphere import icosphere

SIDE = 16


class _Nothing(torch.autograd.Function):
    """Keeps its inputs, and gives them gradients that nobody has written."""

    @staticmethod
    def forward(ctx: Any, *inputs: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(*inputs)
        return torch.empty(1, SIDE, SIDE, 3)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return tuple(torch.empty_like(tensor) for tensor in ctx.saved_tensors)


def small() -> tuple[Callable[[], None], Callable[[], None]]:
    """Forward and backward of twenty triangles, and of nothing."""
    vertices, faces = icosphere(0)
    leaves = [vertices, torch.rand(len(faces), 3), torch.full((len(faces),), 0.95), torch.tensor(0.5)]
    for leaf in leaves:
        leaf.requires_grad_()
    cameras = etsplat.orbit_cameras(SIDE, SIDE)[0]
    cotangent = torch.rand(1, SIDE, SIDE, 3)
    names = ("face_colors", "opacities", "sigma")

    def ours() -> None:
        for leaf in leaves:
            leaf.grad = None
        named = dict(zip(names, leaves[1:], strict=True))
        out = etsplat.rasterize(leaves[0], faces=faces, cameras=cameras, **named)
        out.color.backward(cotangent)

    def nothing() -> None:
        for leaf in leaves:
            leaf.grad = None
        _Nothing.apply(*leaves).backward(cotangent)

    return ours, nothing


def microseconds(action: Callable[[], None], between: Callable[[], object], repeats: int) -> float:
    """First quartile, of the thread's clock."""
    times = []
    for _ in range(repeats):
        between()
        start = time.thread_time()
        action()
        times.append(1e6 * (time.thread_time() - start))
    return statistics.quantiles(times, n=4)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=100)
    repeats = parser.parse_args().repeats
    torch.set_num_threads(1)
    _native.set_num_threads(1)
    sphere = scenes.load("sphere4")
    for name, action in zip(("rasterize", "nothing"), small(), strict=True):
        again = microseconds(action, lambda: None, 10 * repeats)
        after = microseconds(action, lambda: sphere.render().color.backward(sphere.cotangent), repeats)
        print(f"{name:10} {again:6.0f} us again and again, {after:6.0f} us after a picture")


if __name__ == "__main__":
    main()
