"""How time and memory grow with triangles, pixels and views: forward and backward of random soups, a process for each.

python -m benchmarks.growth                      # the cases of docs/performance.md
python -m benchmarks.growth 1000000x1600x1060x1  # triangles x width x height x views

Times are of the processor, over all threads, the lesser of two renders; memory is that by which the process grew at its
peak, images and gradients included.
"""

import argparse
import time
from multiprocessing.connection import Connection
from typing import Any

import torch

import etsplat
from benchmarks.machine import description
from benchmarks.memory import RESET, in_a_process, kibibytes, reset_peak
from etsplat import _native

CASES = (
    *(f"{count}x1600x1060x1" for count in (250_000, 1_000_000, 4_000_000, 10_000_000)),
    *(f"100000x{side}x{side}x1" for side in (1024, 2048, 4096, 8192)),
    *(f"100000x400x300x{views}" for views in (1, 4, 16, 64)),
)
SIZE = 0.004
"""Of triangles, relative to half the soup's side: some seven pixels in 1600."""

RENDERS = 2


def measure(case: str, threads: int, answer: Connection) -> None:
    _native.set_num_threads(threads)
    torch.set_num_threads(1)
    count, width, height, views = map(int, case.split("x"))
    generator = torch.Generator().manual_seed(0)
    center = 2 * torch.rand(count, 1, 3, generator=generator) - 1
    vertices = center + SIZE * torch.randn(count, 3, 3, generator=generator)
    colors, opacities, sigma = (torch.rand(shape, generator=generator) for shape in ((count, 3), (count,), (count,)))
    leaves = [tensor.requires_grad_() for tensor in (vertices, colors, 0.05 + 0.95 * opacities, 0.1 + 0.9 * sigma)]
    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 2, 3] = 3.0
    focal = 1.3 * width
    Ks = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
    cotangent = torch.rand(views, height, width, 3, generator=generator) - 0.5
    before, times, pairs = reset_peak() if RESET.exists() else None, [], 0
    for _ in range(RENDERS):
        for leaf in leaves:
            leaf.grad = None
        start = time.process_time()
        corners, face_colors, opacity, softness = leaves
        out: Any = etsplat.rasterize(
            corners,
            opacities=opacity,
            sigma=softness,
            face_colors=face_colors,
            viewmats=viewmats,
            Ks=Ks,
            width=width,
            height=height,
        )
        out.color.backward(cotangent)
        times.append(1e3 * (time.process_time() - start))
        pairs = sum(state.num_pairs for state in out.color.grad_fn.constants[0].states)
        del out
    grown = None if before is None else (kibibytes("VmHWM") - before) / 1024
    answer.send((pairs, min(times), grown))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=CASES)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    machine = description()
    print(f"{machine['date']}, commit {machine['commit']}, {machine['cpu']}, {options.threads} threads\n")
    print("| triangles | image | views | pairs | ms | ns per pair | ns per pixel | MiB | bytes per pair |")
    print("|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for case in options.cases:
        count, width, height, views = map(int, case.split("x"))
        pairs, ms, grown = in_a_process(measure, case, options.threads)
        memory = ("", "") if grown is None else (f"{grown:,.0f}", f"{grown * 2**20 / pairs:,.0f}")
        numbers = f"{ms:,.0f} | {1e6 * ms / pairs:,.0f} | {1e6 * ms / (views * width * height):,.0f}"
        print(f"| {count:,} | {width}x{height} | {views} | {pairs:,} | {numbers} | {' | '.join(memory)} |", flush=True)


if __name__ == "__main__":
    main()
