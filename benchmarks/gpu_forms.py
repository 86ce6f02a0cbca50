"""What two other forms of the GPU's kernels would spare, counted on the tiles of real captures: needs no GPU.

python -m benchmarks.gpu_forms data/scenes/kitchen25 data/scenes/family --triangles 100000 --width 800

- A backward pass by triangle: each lane of a warp has a triangle of its own and adds up in registers, while the pixels
  of the tile pass from lane to lane. Chosen for each tile by what it takes there.
- Visible triangles compacted before they are sorted by depth.

Tiles are those of the GPU engine, run by the tests' shim (about a minute a view), of a soup that has been grown and
fitted for a while. Both forms are counted at the least that they can take; what they would add is left out.
"""

import argparse
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor

from benchmarks.gpu_code import kernels
from benchmarks.gpu_floors import BACKWARD_PAIR_INSTRUCTIONS, BACKWARD_SLOT_INSTRUCTIONS, PEAKS, Work, floors
from benchmarks.gpu_programs import PROGRAMS
from benchmarks.gpu_scenes import GpuScene
from benchmarks.gpu_timing import hits_of, pairs_of, ranges_of, work_of
from benchmarks.tables import Table
from benchmarks.train_step import grown
from etsplat.core.cameras import Cameras
from etsplat.data.load import load_dataset
from etsplat.engines.cuda.launch import use_backend
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.rasterize import CudaRender
from etsplat.engines.threads import one_torch_thread
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.soup_colors import soup_colors
from etsplat.tasks.train_config import TrainConfig

_LANES, _PIXELS = 32, 256
_SORT_BYTES = 4 * 16 + 4  # of a triangle in four passes and the histogram


class InRegisters(Program):
    """raster_backward, whose sums stay in registers from pair to pair: its loop is right, its result is not."""

    @property
    def source(self) -> str:
        """Raises ValueError where the loop is another one."""
        text, changes = super().source, 0
        for there, instead in (
            (r"for \(; todo != 0;", r"float kept[kStride] = {}; \g<0>"),
            (
                r"#pragma unroll\n +for [^\n]*\n[^\n]*sum_sixteen\(sums [^}]*}",
                "for (int j = 0; j < kStride; ++j) kept[j] += sums[j];",
            ),
            (
                r"__syncthreads\(\);\n +for \(int i = t; i < count",
                r"for (float sum : kept) warp_sums[warp][0][lane] += sum; \g<0>",
            ),
        ):
            text, changed = re.subn(there, instead, text)
            changes += changed
        if changes != 3:
            raise ValueError("raster_backward.cu has changed")
        return text


@cache
def lane_instructions() -> int:
    """Of the pair loop where a lane has a triangle, on sm_90; pixels have yet to be passed on."""
    kept = next(p for p in PROGRAMS if p.file == "raster_backward.cu")
    (kernel,) = kernels(InRegisters(kept.file, kept.defines, kept.contract, kept.flush), "sm_90")
    return kernel.pair


@dataclass(frozen=True)
class Tiles:
    """Of each tile of a picture: (T,) slots that draw something, and (T,) their pairs with sub-tiles."""

    slots: Tensor
    pairs: Tensor

    @property
    def by_pixel(self) -> Tensor:
        """(T,) warp instructions of the loop as it is."""
        return BACKWARD_PAIR_INSTRUCTIONS * self.pairs + BACKWARD_SLOT_INSTRUCTIONS * self.slots

    @property
    def by_triangle(self) -> Tensor:
        """(T,) those of the other form: the last pixel reaches the last lane 31 steps after the first lane."""
        return -(-self.slots // _LANES) * (_PIXELS + _LANES - 1) * lane_instructions()


def tiles_of(render: CudaRender) -> Tiles:
    """Counted in a render's own buffers."""
    hits = hits_of(render)
    listed = render.state.bytes("sorted_slots", 4 * len(hits)).view(torch.int32).long()
    begin, end = ranges_of(render).unbind(dim=1)
    counts = []
    for each in ((hits != 0).long(), pairs_of(hits)):
        sums = torch.nn.functional.pad(each[listed].cumsum(dim=0), (1, 0))
        counts.append(sums[end] - sums[begin])
    return Tiles(*counts)


def scene_of(soup: TriangleSoup, camera: Cameras) -> GpuScene:
    """What is drawn of a soup."""
    with torch.no_grad():
        colors = soup_colors(soup.vertices, soup.sh_dc, soup.sh_rest, camera.centers, soup.sh_degree)[0]
    leaves = [t.detach().clone().requires_grad_() for t in (soup.vertices, colors, soup.opacities, soup.sigma)]
    vertices, colors, opacities, sigma = leaves
    nothing = torch.zeros(1, camera.height, camera.width, 3)
    return GpuScene("soup", vertices, None, colors, None, None, opacities, sigma, camera.viewmats, camera.Ks, nothing)


def counted(scene: GpuScene) -> tuple[Work, Tiles]:
    """By the shim, forward alone: the hits are what backward goes by."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from helpers.simt.build import Simt

    with use_backend(Simt()):
        render: CudaRender = scene.render().color.grad_fn.constants[0]  # type: ignore[union-attr]
        return work_of(scene, render), tiles_of(render)


def rows(path: Path, options: argparse.Namespace, config: TrainConfig) -> Iterator[list[str]]:
    """One for each view."""
    loaded = load_dataset(path, width=options.width)
    capture = loaded.normalized() if config.normalize else loaded
    with one_torch_thread():
        trainer = grown(capture, config)
        for iteration in range(config.iterations - options.further, config.iterations):
            trainer.advance(iteration, iteration)
    for view in capture.train[:: -(-len(capture.train) // options.views)]:
        work, tiles = counted(scene_of(trainer.model, capture.cameras[view]))
        now, other = tiles.by_pixel, tiles.by_triangle
        better = other < now
        sort = _SORT_BYTES * (work.triangles - work.visible) / PEAKS["H100"].bytes_per_second
        whole = sum(floor.ms for floor in floors(work, PEAKS["H100"])) / 1e3
        yield [
            path.name,
            f"{100 * work.visible / work.triangles:.0f} %",
            f"{work.slots / work.visible:.1f}",
            f"{work.hit_pairs / max(work.hit_slots, 1):.2f}",
            f"{100 * float(better.float().mean()):.1f} %",
            f"{float(other.sum() / now.sum()):.2f}",
            f"{float(torch.minimum(now, other).sum() / now.sum()):.3f}",
            f"{1e6 * sort:.2f}",
            f"{100 * sort / whole:.2f} %",
        ]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--further", type=int, default=100, help="steps after growth")
    options = parser.parse_args(arguments)
    changed = {"max_triangles": options.triangles, "pixels_per_triangle": None, "iterations": 100_000}
    changed["schedule.sh_every"] = 1
    config = TrainConfig.of("quick", "outdoor").changed(changed)
    found = [row for path in options.captures for row in rows(path, options, config)]
    columns = ["capture", "visible", "tiles of one", "sub-tiles of a slot", "tiles by triangle", "all by triangle"]
    columns += ["the better for each", "compacted, us", "of forward and backward"]
    Console(width=160).print(
        Table("Other forms, of the H100's instructions and times as they are", columns, found).rich()
    )


if __name__ == "__main__":
    main()
