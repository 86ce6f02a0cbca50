"""What is special to the GPU rasterizer, run by the shim and, where there is one, on a GPU."""

import pytest
import torch

import etsplat
from etsplat import rasterize
from etsplat.engines.cuda import capacity
from etsplat.engines.cuda import rasterize as rasterize_launches
from etsplat.engines.cuda.launch import use_backend
from helpers.agreement import compare
from helpers.scenes import EVERYTHING, IMAGES, gradients, mesh, prepare, soup
from helpers.simt.build import Simt


def test_parts_of_many_channels_leave_out_the_same_triangles(cuda_engine, rng):
    """A triangle with one channel that is not finite is in none of the passes."""
    scene = soup(rng, 30, channels=20)
    scene["face_colors"][7, 18] = torch.inf
    out = gradients(scene, cuda_engine, {"color": torch.ones(2, 40, 48, 20)}, validate=False)[0]
    without = {**scene, **{name: scene[name].clone() for name in ("face_colors", "opacities")}}
    without["face_colors"][7], without["opacities"][7] = 0.0, 0.0
    expected = gradients(without, cuda_engine, {"color": torch.ones(2, 40, 48, 20)})[0]
    assert torch.equal(out.color, expected.color)


@pytest.mark.sanitize
def test_triangles_over_many_tiles(cuda_engine, distance, rng):
    """Boxes of more than 4x4 tiles, more slots than a thread adds up alone, sizes that no tile divides."""
    scene = soup(rng, 25, width=150, height=133, size=6.0, views=1)
    compare(scene, cuda_engine, rng, images=("color",), distance=distance)


@pytest.mark.sanitize
def test_the_order_of_tiles_changes_nothing(cuda_engine, rng, monkeypatch):
    """The fullest tiles first, in two views; some tiles are empty."""
    scene = soup(rng, 60, width=86, height=69, size=1.0)
    cotangents = {"color": torch.randn(2, 69, 86, 3, generator=rng)}
    out, grads = gradients(scene, cuda_engine, cotangents)
    monkeypatch.setattr(rasterize_launches, "_AT_ONCE", 0)
    ordered, ordered_grads = gradients(scene, cuda_engine, cotangents)
    assert torch.equal(ordered.color, out.color)
    assert all(torch.equal(ordered_grads[name], grads[name]) for name in grads)


@pytest.mark.sanitize
def test_many_batches_and_early_termination(cuda_engine, kernel, rng):
    """Hundreds of triangles in each of four tiles; opaque ones, whose pixels and tiles stop."""
    scene = soup(rng, 700, width=24, height=20, size=2.0, views=1)
    compare(scene, cuda_engine, rng, images=("color",), kernel=kernel)
    scene["opacities"] = torch.ones(700)
    compare(scene, cuda_engine, rng, images=("color",), kernel=kernel)


@pytest.mark.sanitize
def test_more_pairs_than_room(cuda_engine, cuda_device, rng, monkeypatch):
    """The render is repeated with more room, and is the one that had enough from the start."""
    scene, cotangents = soup(rng, 80), {"color": torch.randn(2, 40, 48, 3, generator=rng)}
    expected, expected_grads = gradients(scene, cuda_engine, cotangents)
    monkeypatch.setattr(capacity, "_seen", {})
    monkeypatch.setattr(capacity, "_FIRST_ROOM", 20)
    monkeypatch.setattr(capacity, "_FIRST_PER_TRIANGLE", 0)
    out, grads = gradients(scene, cuda_engine, cotangents)
    assert torch.equal(out.color, expected.color)
    assert all(torch.equal(grads[name], expected_grads[name]) for name in grads)
    assert int(capacity.overflow_flag(cuda_device)) == 0


def test_a_repair_does_not_take_earlier_captures_for_smaller_scenes(cuda_device, monkeypatch):
    """A graph that was captured before triangles multiplied does not multiply the room once more."""
    for name in ("_seen", "_captured"):
        monkeypatch.setattr(capacity, name, {})
    shape = (1, 64, 64)
    capacity.note_capture(cuda_device, shape, 100)
    capacity.record_need(cuda_device, shape, 10_000, 50_000)
    capacity.overflow_flag(cuda_device).fill_(80_000)
    assert capacity.repair_overflow(cuda_device)
    assert capacity.capacity_for(cuda_device, shape, 10_000) == 100_000


def test_overflow_inside_a_graph_is_found_afterwards(simt, rng, monkeypatch):
    """Nothing is read while a graph is captured: the device remembers, and the repair makes room."""
    scene, cotangents = soup(rng, 80), {"color": torch.randn(2, 40, 48, 3, generator=rng)}
    expected, _ = gradients(scene, "cuda", cotangents)
    for name, value in (("_seen", {}), ("_FIRST_ROOM", 20), ("_FIRST_PER_TRIANGLE", 0), ("_captured", {})):
        monkeypatch.setattr(capacity, name, value)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Simt, "capturing", True)
        gradients(scene, "cuda", cotangents)
    device = torch.device("cpu")
    assert int(capacity.overflow_flag(device)) > 20
    assert capacity.repair_overflow(device)
    out, _ = gradients(scene, "cuda", cotangents)
    assert not capacity.repair_overflow(device)
    assert torch.equal(out.color, expected.color)


def test_bits_do_not_depend_on_the_order_of_threads(rng):
    """Whichever fiber starts, images, statistics and gradients are the same bits."""
    scene = mesh(rng)
    cotangents = {
        name: torch.randn(2, 40, 48, 3 if name in ("color", "normal") else 1, generator=rng) for name in IMAGES
    }
    results = []
    for seed in (0, 3, 8):
        with use_backend(Simt(seed)):
            results.append(gradients(scene, "cuda", cotangents, **EVERYTHING))
    first, first_grads = results[0]
    for out, grads in results[1:]:
        assert all(torch.equal(getattr(out, name), getattr(first, name)) for name in IMAGES)
        assert torch.equal(out.statistics.max_weight, first.statistics.max_weight)
        assert all(torch.equal(grads[name], first_grads[name]) for name in grads)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_captured_step_is_the_eager_one(rng):
    """Forward and backward as a graph, replayed on changed vertices, give the bits of single calls."""
    scene = prepare(soup(rng, 200), "cuda", requires_grad=True)
    cotangent = torch.randn(2, 40, 48, 3, generator=rng).cuda()
    leaves = [scene[name] for name in ("vertices", "face_colors", "opacities", "sigma")]

    def step():
        with etsplat.engine("cuda"):
            out = rasterize(**scene)
        return [out.color, *torch.autograd.grad(out.color, leaves, cotangent)]

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    with torch.no_grad():
        leaves[0] += 0.05
    graph.replay()
    assert not capacity.repair_overflow(leaves[0].device)
    assert all(torch.equal(a, b) for a, b in zip(captured, step(), strict=True))
