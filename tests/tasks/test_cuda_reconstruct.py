"""Whole steps of shape reconstruction on the GPU engine, by the shim and, where there is one, on a GPU."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.engines.cuda.steps import Repeated
from etsplat.tasks.reconstruct import make_trainer, reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starts import make_start
from helpers.simt.build import Simt
from helpers.simt.calls import Calls
from helpers.simt.room import room_for_16_pairs, second_step_overflows
from helpers.trainers import OnEngine, same_bits

CPU = torch.device("cpu")
# 320 faces, subdivided after iterations 2 and 5.
CONFIG = ReconstructConfig.tiny().changed(
    {
        "resolution": 32,
        "iterations": 6,
        "max_faces": 500,
        "refinement.first": 0.3,
        "refinement.last": 0.8,
        "refinement.subdivisions": 2,
        "regularization.hold": 2,
        "output.log_every": 4,
        "output.evaluate_every": 0,
        "output.checkpoint_every": 4,
        "output.chamfer_samples": 500,
    }
)
UNREFINED = {"refinement.first": 0.1, "refinement.subdivisions": 0}


@pytest.fixture(scope="module")
def views() -> Dataset:
    return photograph(demo_object(), 32, 32, elevations=(-35.0, 35.0), azimuths=3, supersampling=2)


def fitting(views: Dataset, engine: str, config: ReconstructConfig = CONFIG, device: torch.device = CPU) -> OnEngine:
    return OnEngine(engine, lambda: make_trainer(make_start(None, views, config, device).mesh, views, config))


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "elastic"},
        {"method": "single-sided", "drawing.colors": "vertex"},
        {"method": "raster-face"},
        {
            "pictures.coarse_levels": 1,
            "pictures.coarse_until": 0.6,
            "batch": 2,
            "optimizer.sigma_final": 0.2,
            "refinement.untanglings": 2,
        },
        {"optimizer.vertex_update": "large-steps"},
        {"drawing.opaque_from": 0.5},
        {"drawing.harmonics": 2, "drawing.opaque_from": 0.5},
    ],
    ids=lambda settings: next(iter(settings.values())),
)
def test_steps_are_those_of_the_cpu_engine(cuda_device: torch.device, views: Dataset, settings: dict[str, Any]) -> None:
    """Six steps and two subdivisions: the same faces, losses and parameters to rounding; Adam divides small gradients
    by small ones, so one parameter in a hundred may differ by more."""
    config = CONFIG.changed(settings)
    on_device, on_cpu = fitting(views, "cuda", config, cuda_device), fitting(views, "cpu", config)
    assert on_device.run(6) == pytest.approx(on_cpu.run(6), rel=1e-5)
    assert on_device.model.count == on_cpu.model.count > 320
    expected = on_cpu.model.parameters()
    for name, parameter in on_device.model.parameters().items():
        difference = (parameter.cpu() - expected[name]).detach().abs()
        assert float((difference > 1e-5).float().mean()) < 0.01, name


def test_steps_queued_together_are_the_steps_one_by_one(cuda_device: torch.device, views: Dataset) -> None:
    """The same bits, however many steps are queued before the host looks, and though room runs out on the way."""
    config = CONFIG.changed(UNREFINED)
    together, one_by_one = (fitting(views, "cuda", config, cuda_device) for _ in range(2))
    losses = together.advance(1, 1)
    with room_for_16_pairs() as repairs:
        losses += together.advance(2, 5)
    assert any(repairs)
    assert losses == [one_by_one.advance(i, i)[0] for i in range(1, 6)]
    same_bits(together, one_by_one)


def test_replayed_steps_are_those_that_are_called(cuda_device: torch.device, views: Dataset, monkeypatch) -> None:
    """The same bits with graphs and without: all that changes from step to step is in device memory."""
    config = CONFIG.changed(
        {**UNREFINED, "iterations": 9, "optimizer.sigma_final": 0.2, "batch": 2, "drawing.opaque_from": 0.6}
    )
    replayed, called = (fitting(views, "cuda", config, cuda_device) for _ in range(2))
    losses = replayed.run(9)
    monkeypatch.setattr(Repeated, "__call__", lambda self: self._body())
    assert called.run(9) == losses
    same_bits(replayed, called)


@pytest.mark.parametrize(("method", "reads", "kernels"), [("elastic", 1, 21), ("raster-vertex", 0, 17)])
def test_a_queued_step_reads_nothing_back(simt: Simt, views: Dataset, method: str, reads: int, kernels: int) -> None:
    """Nothing in a step waits for the device, but for the rasterizer's look at its room outside of captured graphs; and
    few small kernels of torch are left (four of them group corners by vertex)."""
    problem = fitting(views, "cuda", replace(CONFIG, method=method))
    problem.advance(1, 1)  # fills caches
    kind = next(iter(problem.queue._repeated))
    problem.queue._position.zero_()
    with Calls() as calls:
        problem.step_again(kind)
    assert calls.waiting() == reads
    assert calls.kernels() <= kernels


def test_a_step_whose_buffers_overflow_is_made_again(simt: Simt, views: Dataset) -> None:
    """While the flag is set nothing changes; after the repair the queue goes on where it stopped."""
    problem, undisturbed = fitting(views, "cuda"), fitting(views, "cuda")
    with second_step_overflows(problem.queue, CPU) as steps:
        assert problem.run(2) == undisturbed.run(2)
    assert len(steps) == 3
    same_bits(problem, undisturbed)


def test_a_loss_that_is_not_finite_stops_the_queue(cuda_device: torch.device, views: Dataset) -> None:
    """The losses end with it, and no step was made from there on."""
    problem = fitting(views, "cuda", device=cuda_device)
    with torch.no_grad():
        problem.model.vertices[0] = math.nan
    before = problem.model.colors.detach().clone()
    losses = problem.advance(1, 2)
    assert len(losses) == 1
    assert math.isnan(losses[0])
    assert torch.equal(problem.model.colors, before)


def test_a_resumed_run_ends_with_the_same_bits(cuda_device: torch.device, views: Dataset) -> None:
    """State saved after iteration 4 and loaded into a new problem leads to the same parameters."""
    whole = fitting(views, "cuda", device=cuda_device)
    losses = whole.run(4)
    resumed = fitting(views, "cuda", device=cuda_device)
    resumed.trainer.load_state(whole.state(), 4)
    for problem in (whole, resumed):
        for first, last in ((5, 5), (6, 6)):
            losses += problem.advance(first, last)
            problem.refine(last)
    assert losses[4:6] == losses[6:8]
    same_bits(whole, resumed)


def test_a_whole_run_leaves_its_directory(cuda_device: torch.device, tmp_path: Path) -> None:
    """From photographs to metrics.json, with the engine's name in it."""
    result = reconstruct(demo_object(), tmp_path, replace(CONFIG, engine="cuda", iterations=2, resolution=16))
    assert result.metrics["engine"] == "cuda"
    assert result.metrics["iterations"] == 2
    assert (tmp_path / "mesh.ply").exists()
