"""Steps of a triangle soup on the GPU engine, by the shim and, where there is one, on a GPU."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from etsplat.scene.captures import Capture
from etsplat.scene.demo_scene import demo_scene
from etsplat.scene.soup_init import StartPoints, start_soup
from etsplat.tasks.soup_fitting import SoupFitting
from etsplat.tasks.train import train
from etsplat.tasks.train_config import train_settings

CONFIG = replace(train_settings("tiny"), iterations=6, densify_every=15_000, densify_from=0, sh_every=5000)


@pytest.fixture(scope="module")
def capture() -> Capture:
    return demo_scene(40, 32)


def fitting(capture: Capture, engine: str, device: torch.device) -> SoupFitting:
    generator = torch.Generator().manual_seed(3)
    assert capture.points is not None
    chosen = capture.points[::150]
    soup = start_soup(
        StartPoints(chosen, torch.full_like(chosen, 0.5)), generator, scale=2.0, opacity=0.4, sigma=1.0, sh_degree=1
    )
    return SoupFitting(soup.to(device), capture, replace(CONFIG, engine=engine), generator, lambda *_: {})


def test_steps_are_those_of_the_cpu_engine(cuda_device: torch.device, capture: Capture) -> None:
    """Three steps, a densification and one more: the same losses, triangles and statistics to rounding."""
    on_device, on_cpu = fitting(capture, "cuda", cuda_device), fitting(capture, "cpu", torch.device("cpu"))
    before = on_cpu.count
    for iteration in range(1, 5):
        losses = [problem.advance(iteration, 6)[0] for problem in (on_device, on_cpu)]
        assert losses[0] == pytest.approx(losses[1], rel=1e-5)
        assert on_device.refine(iteration) == on_cpu.refine(iteration)
    assert on_device.count == on_cpu.count > before
    for name, tensor in on_cpu.statistics.tensors().items():
        torch.testing.assert_close(on_device.statistics.tensors()[name].cpu(), tensor, rtol=1e-3, atol=1e-4)
    for name, parameter in on_cpu.soup.parameters().items():
        difference = (on_device.soup.parameters()[name].cpu() - parameter).detach().abs()
        assert float((difference > 1e-4).float().mean()) < 0.01, name


def test_a_whole_run_leaves_its_directory(cuda_device: torch.device, capture: Capture, tmp_path: Path) -> None:
    """From photos to a soup in a file, with the engine's name beside it."""
    assert capture.exact_points is not None
    assert capture.point_colors is not None
    few = replace(
        capture,
        exact_points=capture.exact_points[::400],
        point_colors=capture.point_colors[::400],
        test=capture.test[:1],
    )
    result = train(few, tmp_path / "run", replace(CONFIG, engine="cuda", iterations=2, sky_dome=False))
    assert result.metrics["engine"] == "cuda"
    assert result.metrics["psnr"] > 5
    assert result.soup.vertices.device.type == "cpu"
    assert (tmp_path / "run" / "soup.safetensors").exists()
