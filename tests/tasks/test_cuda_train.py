"""Steps of a triangle soup on the GPU engine, by the shim and, where there is one, on a GPU."""

import math
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.pictures import StoredPictures
from etsplat.engines.cuda.steps import Repeated
from etsplat.model.soup_init import StartPoints, start_soup
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.objective import Custom, Drawing, Objective
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import Trainer
from etsplat.tasks.soup_trainer import make_trainer
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from helpers.simt.build import Simt
from helpers.simt.calls import Calls
from helpers.simt.room import room_for_16_pairs, second_step_overflows
from helpers.trainers import OnEngine, same_bits

# Densified after iteration 3; the degree rises after iteration 4.
CONFIG = TrainConfig.tiny().changed(
    {
        "iterations": 6,
        "optimizer.lr_vertices_length": None,  # so that the steps of a few iterations are no larger than those of many
        "densification.every": 15_000,
        "densification.begin": 0,
        "schedule.sh_every": 20_000,
    }
)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def capture() -> Dataset:
    """Photos of two sizes, some of them with an alpha channel, and a mask for one in three."""
    scene = demo_scene(40, 32)
    pixels = [image[:24] if index % 2 else image for index, image in enumerate(scene.images)]
    for index in range(0, len(pixels), 4):
        alpha = torch.full((*pixels[index].shape[:2], 1), 255, dtype=torch.uint8)
        pixels[index] = torch.cat([pixels[index], alpha], dim=-1)
    masks = [left_half(image) if index % 3 == 0 else None for index, image in enumerate(pixels)]
    return replace(scene, images=StoredPictures(pixels, masks))


def left_half(image: torch.Tensor) -> torch.Tensor:
    """Which counts."""
    mask = torch.zeros(image.shape[:2], dtype=torch.uint8)
    mask[:, :20] = 255
    return mask


def fitting(capture: Dataset, engine: str, device: torch.device = CPU, config: TrainConfig = CONFIG) -> OnEngine:
    assert capture.points is not None
    chosen = capture.points[::150]
    generator = torch.Generator().manual_seed(3)
    soup = start_soup(
        StartPoints(chosen, torch.full_like(chosen, 0.5)), generator, scale=2.0, opacity=0.4, sigma=1.0, sh_degree=1
    )
    return OnEngine(engine, lambda: make_trainer(soup.to(device), capture, config, generator=generator))


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"finish": "opaque", "drawing.cull_small": True},
        {
            "loss.lambda_depth_normal": 0.05,
            "loss.lambda_distortion": 0.1,
            "loss.lambda_size": 1e-6,
            "loss.regularize_from": 10_000,
        },
        {"method": "single-sided", "background": "random"},
        {"batch": 2},
        {"drawing.dropout": 4.5},
    ],
    ids=["plain", "finish", "paper", "single-sided", "batch", "dropout"],
)
def test_steps_are_those_of_the_cpu_engine(cuda_device: torch.device, capture: Dataset, settings: Any) -> None:
    """Three steps: the same losses, and statistics to rounding but for a few triangles, and parameters but for
    one, where Adam divided small gradients by small ones; then a densification and three more."""
    config = CONFIG.changed(settings)
    on_device, on_cpu = fitting(capture, "cuda", cuda_device, config), fitting(capture, "cpu", CPU, config)
    before = on_cpu.model.count
    losses, expected = ([loss for i in (1, 2, 3) for loss in p.advance(i, i)] for p in (on_device, on_cpu))
    assert losses == pytest.approx(expected, rel=1e-5)
    for name, tensor in on_cpu.trainer.strategy.statistics.tensors().items():
        difference = (on_device.trainer.strategy.statistics.tensors()[name].cpu() - tensor).abs()
        assert float((difference > 1e-4 + 1e-3 * tensor.abs()).float().mean()) < 0.05, name
    for name, parameter in on_cpu.model.parameters().items():
        difference = (on_device.model.parameters()[name].cpu() - parameter).detach().abs()
        assert int((difference > 1e-4).reshape(len(difference), -1).any(dim=1).sum()) <= 1, name  # of 27
    assert on_device.refine(3) == on_cpu.refine(3) > 0
    losses, expected = ([loss for i in (4, 5, 6) for loss in p.advance(i, i)] for p in (on_device, on_cpu))
    assert losses == pytest.approx(expected, rel=1e-3)
    assert on_device.model.count == on_cpu.model.count > before


def test_steps_queued_together_are_the_steps_one_by_one(cuda_device: torch.device) -> None:
    """The same bits, however many steps are queued before the host looks, and though room runs out on the way."""
    capture, config = demo_scene(40, 32), CONFIG.changed({"densification.begin": 25_000, "drawing.dropout": 4.5})
    together, one_by_one = (fitting(capture, "cuda", cuda_device, config) for _ in range(2))
    losses = together.advance(1, 1)
    with room_for_16_pairs() as repairs:
        while len(losses) < 6:
            losses += together.advance(len(losses) + 1, 6)
    assert any(repairs)
    assert losses == one_by_one.run(6, together=1)
    same_bits(together, one_by_one)


def test_replayed_steps_are_those_that_are_called(cuda_device: torch.device, monkeypatch) -> None:
    """The same bits with graphs and without: all that changes from step to step is in device memory."""
    capture, changing = demo_scene(40, 32), {"finish": "opaque", "background": "random"}
    config = CONFIG.changed(
        {
            "iterations": 9,
            "densification.every": 30_000,
            "loss.lambda_depth_normal": 0.1,
            "loss.regularize_from": 0,
            **changing,
        }
    )
    replayed = fitting(capture, "cuda", cuda_device, config)
    losses = replayed.run(9)
    monkeypatch.setattr(Repeated, "__call__", lambda self: self._body())
    called = fitting(capture, "cuda", cuda_device, config)
    assert called.run(9) == losses
    same_bits(replayed, called)


@pytest.mark.parametrize("batch", [1, 2])
def test_streamed_photos_give_the_same_bits(cuda_device: torch.device, capture: Dataset, batch: int) -> None:
    """Where photos do not fit, those of a step are uploaded before it."""
    images = copy(capture.images)
    images.streamed = True  # type: ignore[misc]
    streamed, kept = (
        fitting(replace(capture, images=i), "cuda", cuda_device, replace(CONFIG, batch=batch))
        for i in (images, capture.images)
    )
    assert streamed.run(6) == kept.run(6)
    same_bits(streamed, kept)


PAPER = {
    "drawing.cull_small": True,
    "loss.lambda_depth_normal": 0.1,
    "loss.lambda_distortion": 0.1,
    "loss.lambda_harmonics": 0.0,
    "loss.lambda_size": 1e-6,
    "loss.regularize_from": 0,
}


@pytest.mark.parametrize(
    ("settings", "kernel"),
    [({}, "soup_adam"), (PAPER, "soup_adam"), ({"batch": 2}, "soup_backward")],
    ids=["quick", "paper", "batch"],
)
def test_coefficients_are_stepped_with_their_gradient(
    simt: Simt, capture: Dataset, monkeypatch: pytest.MonkeyPatch, settings: Any, kernel: str
) -> None:
    """In steps of one view, with the bits of steps that make it first, over a densification and a higher degree."""
    runs = []
    for colored in (TriangleSoup.COLORED, None):
        monkeypatch.setattr(TriangleSoup, "COLORED", colored)
        simt.launches.clear()
        problem = fitting(capture, "cuda", config=CONFIG.changed(settings))
        runs.append((problem, problem.run(6), {"soup_adam", "soup_backward"} & set(simt.launches)))
    (first, losses, kernels), (second, expected, others) = runs
    assert kernels == {kernel}
    assert others == {"soup_backward"}
    assert losses == expected
    same_bits(first, second)


def test_a_term_may_draw_the_view_again(
    cuda_device: torch.device, capture: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colours are made twice then, and the gradients of all of them arrive."""

    def again(drawing: Drawing) -> torch.Tensor:
        return drawing.model.render(drawing.camera, backgrounds=drawing.background).color.square().mean()

    def trainer() -> Trainer[TriangleSoup]:
        soup = fitting(capture, "cuda", cuda_device).model
        return Trainer(soup, capture, Objective(Photometric(0.2), [Custom(again, 0.5)]), seed=3)

    problem = OnEngine("cuda", trainer)
    losses = problem.run(4)
    monkeypatch.setattr(TriangleSoup, "COLORED", None)
    expected = OnEngine("cuda", trainer)
    assert losses == pytest.approx(expected.run(4), rel=1e-5)
    for name, tensor in problem.model.parameters().items():
        torch.testing.assert_close(tensor, expected.model.parameters()[name], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("settings", "own", "kernels"), [({}, 25, 18), (PAPER, 37, 34)], ids=["quick", "paper"])
def test_a_queued_step_reads_nothing_back(simt: Simt, settings: Any, own: int, kernels: int) -> None:
    """Nothing in a step waits for the device, but for the rasterizer's look at its room outside of captured graphs; and
    few small kernels of torch are left."""
    problem = fitting(demo_scene(40, 32), "cuda", config=CONFIG.changed(settings))
    problem.advance(1, 1)  # fills caches
    kind = next(iter(problem.queue._repeated))
    problem.queue._position.zero_()
    simt.launches.clear()
    with Calls() as calls:
        problem.step_again(kind)
    assert calls.waiting() == 1
    assert len(simt.launches) == own
    assert calls.kernels() <= kernels


def test_a_step_whose_buffers_overflow_is_made_again(simt: Simt, capture: Dataset) -> None:
    """While the flag is set nothing changes; after the repair the queue goes on where it stopped."""
    problem, undisturbed = fitting(capture, "cuda"), fitting(capture, "cuda")
    with second_step_overflows(problem.queue, CPU) as steps:
        assert problem.run(3) == undisturbed.run(3)
    assert len(steps) == 5  # the second and what was queued behind it, twice
    same_bits(problem, undisturbed)


def test_a_loss_that_is_not_finite_stops_the_queue(cuda_device: torch.device, capture: Dataset) -> None:
    """The losses end with it, and nothing has changed from there on, statistics included."""
    problem = fitting(capture, "cuda", cuda_device)
    with torch.no_grad():
        problem.model.opacity_logits[0] = math.nan
    before = problem.model.sh_rest.detach().clone()
    losses = problem.advance(1, 3)
    assert len(losses) == 1
    assert math.isnan(losses[0])
    assert torch.equal(problem.model.sh_rest, before)
    assert int(problem.trainer.strategy.statistics.trial.max()) == 0


def test_a_resumed_run_ends_with_the_same_bits(cuda_device: torch.device, capture: Dataset) -> None:
    """State saved after iteration 4 and loaded into a new problem leads to the same soup and statistics."""
    whole = fitting(capture, "cuda", cuda_device)
    whole.run(4)
    resumed = fitting(capture, "cuda", cuda_device)
    resumed.trainer.load_state(whole.state(), 4)
    losses = []
    for problem in (whole, resumed):
        for first, last in ((5, 5), (6, 6)):
            losses += problem.advance(first, last)
    assert losses[:2] == losses[2:]
    same_bits(whole, resumed)


def test_a_whole_run_leaves_its_directory(cuda_device: torch.device, tmp_path: Path) -> None:
    """From photos to a soup in a file, with the engine's name beside it."""
    capture = demo_scene(40, 32)
    assert capture.exact_points is not None
    assert capture.point_colors is not None
    few = replace(
        capture,
        exact_points=capture.exact_points[::400],
        point_colors=capture.point_colors[::400],
        test=capture.test[:1],
    )
    result = train(few, tmp_path / "run", replace(CONFIG, engine="cuda", iterations=2, sky="none"))
    assert result.metrics["engine"] == "cuda"
    assert result.metrics["psnr"] > 5
    assert result.soup.vertices.device.type == "cpu"
    assert (tmp_path / "run" / "soup.safetensors").exists()
