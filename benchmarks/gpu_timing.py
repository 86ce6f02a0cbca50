"""Times of a scene on a GPU by events, eager and in a captured graph, and the work counted from its buffers."""

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.gpu_floors import Work
from benchmarks.gpu_scenes import GpuScene
from etsplat import _native
from etsplat.engines.cuda.capacity import repair_overflow
from etsplat.engines.cuda.launch import use_backend
from etsplat.engines.cuda.rasterize import CudaRender

WARM_UP = 5


def step(scene: GpuScene) -> None:
    """Forward and backward."""
    for leaf in scene.leaves:
        leaf.grad = None
    scene.render().color.backward(scene.cotangent)


def forward(scene: GpuScene) -> None:
    with torch.no_grad():
        scene.render()


def event_times(run: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Median and quartiles in milliseconds of single calls, each between two events."""
    for _ in range(WARM_UP):
        run()
    times = []
    for _ in range(repeats):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        run()
        end.record()
        end.synchronize()
        times.append(begin.elapsed_time(end))
    low, median, high = statistics.quantiles(times, n=4)
    return {"median": median, "low": low, "high": high}


def captured(scene: GpuScene) -> torch.cuda.CUDAGraph:
    """The step as a graph, after it ran often enough for every kernel and capacity to be known."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(WARM_UP):
            step(scene)
    torch.cuda.current_stream().wait_stream(side)
    for leaf in scene.leaves:
        leaf.grad = None
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        step(scene)
    graph.replay()
    if repair_overflow(scene.vertices.device):
        return captured(scene)
    return graph


def kernel_times(run: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Milliseconds per call of ``run`` that each kernel takes, by torch's profiler."""
    run()
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(repeats):
            run()
        torch.cuda.synchronize()
    return {event.key: event.device_time_total / 1e3 / repeats for event in profile.key_averages()}


def measure(scene: GpuScene, repeats: int) -> dict[str, Any]:
    """Everything about one scene, as plain data."""
    milliseconds = {
        "forward": event_times(lambda: forward(scene), repeats),
        "forward + backward": event_times(lambda: step(scene), repeats),
    }
    work = count(scene)
    kernels = kernel_times(lambda: step(scene), min(repeats, 20))
    milliseconds["forward + backward, captured graph"] = event_times(captured(scene).replay, repeats)
    return {"milliseconds": milliseconds, "work": asdict(work), "kernels": kernels}


def count(scene: GpuScene) -> Work:
    """The work of one step."""
    out = scene.render()
    out.color.backward(scene.cotangent)
    return work_of(scene, out.color.grad_fn.constants[0])  # type: ignore[union-attr]


def work_of(scene: GpuScene, render: CudaRender) -> Work:
    """The work of a render and its backward pass, from its buffers."""
    hits = hits_of(render)
    visible = render.state.bytes("spans", 8 * len(scene.opacities)).view(torch.int32).view(-1, 2)[:, 1] != 0
    batch, height, width, channels = scene.cotangent.shape
    return Work(
        triangles=len(scene.opacities),
        visible=int(visible.sum()),
        vertices=0 if scene.faces is None else len(scene.vertices),
        slots=len(hits),
        hit_slots=int((hits != 0).sum()),
        hit_pairs=int(pairs_of(hits).sum()),
        pixels=batch * height * width,
        tiles=batch * -(-height // _native.TILE) * -(-width // _native.TILE),
        channels=channels,
    )


def hits_of(render: CudaRender) -> Tensor:
    """(slots,) uint8: a bit for each sub-tile in which the slot draws something."""
    return render.state.bytes("hits", int(render.zeros[_counters(render)]))


def pairs_of(hits: Tensor) -> Tensor:
    """How many bits there are."""
    return torch.stack([(hits >> bit) & 1 for bit in range(8)]).sum(dim=0, dtype=torch.int64)


def ranges_of(render: CudaRender) -> Tensor:
    """(tiles, 2): where the slots of each tile begin and end, among the sorted ones."""
    begin = _counters(render) + 2
    return render.zeros[begin : begin + 2 * render.tile_count].view(-1, 2).long()


def _counters(render: CudaRender) -> int:
    """Where the number of slots is, among what was zero at first (`CudaRender`)."""
    return 2 + 2 * -(-render.projected // 1024)


class _Nothing:
    """A backend whose launches do nothing."""

    device_type = "cpu"
    capturing = False

    def memory_pool(self) -> None:
        """None."""

    def warm_up(self, body: Callable[[], None]) -> None:
        """As any call."""
        body()

    def capture(self, body: Callable[[], None], pool: Any) -> Callable[[], None]:
        """The body itself."""
        body()
        return body

    def launch(self, *arguments: Any) -> None:
        """Nothing."""


def host_milliseconds(scene: GpuScene, repeats: int) -> float:
    """Processor time that a step of forward and backward takes outside of kernels, on small tensors of the CPU."""
    scene.cotangent = scene.cotangent[:, :64, :64].contiguous()
    with use_backend(_Nothing()):
        for _ in range(WARM_UP):
            step(scene)
        begin = time.process_time()
        for _ in range(repeats):
            step(scene)
        return 1e3 * (time.process_time() - begin) / repeats


def count_without_gpu(scene: GpuScene) -> Work:
    """The same numbers by the tests' SIMT shim."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from helpers.simt.build import Simt

    with use_backend(Simt()):
        return count(scene)
