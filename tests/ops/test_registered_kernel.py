"""Kernels registered from Python draw in every engine what their functions say."""

from typing import Any

import pytest
import torch

import etsplat
from etsplat import _native
from etsplat.core.kernel_table import KNOTS, KernelTable
from etsplat.core.kernels import KERNELS
from etsplat.core.registered_kernels import adopt_table
from helpers.agreement import compare
from helpers.scenes import EVERYTHING, IMAGES, gradients, mesh, render, soup
from helpers.tolerances import assert_close_to_scale

SMOOTH = ("single_sided", "bilateral", "elastic")


@pytest.fixture(autouse=True)
def _registry():
    """What a test registers is forgotten after it."""
    before = dict(KERNELS)
    yield
    KERNELS.clear()
    KERNELS.update(before)


@pytest.fixture(params=["cpu", "cuda"])
def native_engine(request, simt):
    """The engines that read a table; "cuda" by the shim."""
    return request.param


def registered_again(name: str) -> str:
    etsplat.register_kernel(f"my_{name}", KERNELS[name].value)
    return f"my_{name}"


def waves(x, sigma):
    """Rings that get fainter outwards."""
    return torch.exp(-2 * x) * (0.6 + 0.4 * torch.cos(5 * x * (1 + 0.1 * sigma)))


def soft_soup(rng, low=0.02, high=2.0, count=150, **options):
    """Softness from sharp to flat, at random in each triangle."""
    sigma = low * (high / low) ** torch.rand(count, generator=rng)
    return {**soup(rng, count, **options), "sigma": sigma}


def compare_with_the_built_in(scene, engine, rng, name, tolerance, **options):
    """Images and gradients of a kernel registered again are those that the built-in one has in float64."""
    shape = (len(scene["viewmats"]), scene["height"], scene["width"])
    cotangents = {"color": torch.randn(*shape, 3, generator=rng), "alpha": torch.randn(*shape, 1, generator=rng)}
    oracle, oracle_grads = gradients(scene, "reference", cotangents, torch.float64, kernel=name, **options)
    out, grads = gradients(scene, engine, cotangents, torch.float32, kernel=registered_again(name), **options)
    for image in cotangents:
        error = (getattr(out, image).detach().cpu().double() - getattr(oracle, image).detach()).abs()
        assert float(error.quantile(0.999)) < 1e-3, image
        assert float(error.max()) < 2e-2, image
    for key, expected in oracle_grads.items():
        assert_close_to_scale(grads[key], expected, tolerance, name=f"gradient of {key}")


@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_kernels_registered_again(engine, distance, name, rng):
    low = 0.5 if name == "single_sided" else 0.02
    compare_with_the_built_in(soft_soup(rng, low), engine, rng, name, 0.01, distance=distance)


def test_sharp_single_sided_kernel_registered_again(engine, distance, rng):
    """Its slope at the edge is unbounded: gradients are a little farther off."""
    compare_with_the_built_in(soft_soup(rng, high=0.5), engine, rng, "single_sided", 0.03, distance=distance)


@pytest.mark.sanitize
@pytest.mark.parametrize("instruction_set", _native.available_instruction_sets())
def test_every_instruction_set_draws_the_interpolant(instruction_set, distance, rng):
    """The reference, given the table as a function, has the same images and gradients: all shapes of the tile loops."""
    _adopted(waves)
    before = _native.instruction_set()
    try:
        _native.set_instruction_set(instruction_set)
        # A table's slope has kinks at its knots, and rounding decides on which side of one a pixel is.
        compare(soft_soup(rng, 0.2, count=80), "cpu", rng, IMAGES, 3.0, kernel="mine", distance=distance, **EVERYTHING)
        compare(mesh(rng), "cpu", rng, images=("color",), kernel="mine", distance=distance)
    finally:
        _native.set_instruction_set(before)


@pytest.mark.sanitize
def test_gpu_engine_draws_the_interpolant(cuda_engine, distance, rng):
    _adopted(waves)
    scene = soft_soup(rng, 0.2, count=60)
    compare(scene, cuda_engine, rng, IMAGES, 3.0, kernel="mine", distance=distance, **EVERYTHING)


def _adopted(value) -> None:
    """Register "mine" as a file brings it: the table alone."""
    etsplat.register_kernel("mine", value)
    table = KERNELS.pop("mine").table
    assert table is not None
    adopt_table("mine", KernelTable.from_tensors(table.to_tensors()))


@pytest.mark.parametrize("name", [*SMOOTH, "waves"])
def test_the_extent_leaves_out_nothing(native_engine, name, rng, monkeypatch):
    """Drawn without it, up to x_max and to the alpha test alone, every bit is the same."""
    etsplat.register_kernel("mine", waves if name == "waves" else KERNELS[name].value)
    scene = soft_soup(rng)
    scene["opacities"][::5] = 0.005  # hardly visible: the extent is short
    cotangents = {"color": torch.randn(2, 40, 48, 3, generator=rng)}
    out, grads = gradients(scene, native_engine, cotangents, kernel="mine")
    table = KERNELS["mine"].table
    assert table is not None
    monkeypatch.setattr(KernelTable, "_reach", property(lambda self: torch.ones(len(self.values) - 1, KNOTS)))
    table._native.clear()  # what the engines were given is made anew
    everywhere, everywhere_grads = gradients(scene, native_engine, cotangents, kernel="mine")
    assert torch.equal(out.color, everywhere.color)
    assert torch.equal(out.alpha, everywhere.alpha)
    for key, expected in everywhere_grads.items():
        assert torch.equal(grads[key], expected), key


def test_the_extent_is_about_that_of_the_built_in_kernel(rng):
    """The test above would pass if nothing were left out."""
    name, scene = registered_again("elastic"), {**soft_soup(rng), "backgrounds": None}
    tiles = []
    for kernel in ("elastic", name):
        out = gradients(scene, "cpu", {"color": torch.ones(2, 40, 48, 3)}, kernel=kernel)[0]
        node: Any = out.color.grad_fn
        tiles.append(sum(state.num_pairs for state in node.constants[0].states))
    assert tiles[0] <= tiles[1] < 1.2 * tiles[0]


def test_outside_of_the_range_the_native_engines_take_the_nearest_row(rng):
    """And there is no gradient by sigma."""
    etsplat.register_kernel("mine", KERNELS["elastic"].value, sigma=(0.3, 0.8))
    scene = soup(rng, 60)
    images = []
    for sigma in (0.05, 0.3, 0.8, 5.0):
        cotangents = {"color": torch.ones(2, 40, 48, 3)}
        out, grads = gradients({**scene, "sigma": torch.full((60,), sigma)}, "cpu", cotangents, kernel="mine")
        images.append(out.color)
        assert bool((grads["sigma"] == 0).all()) == (sigma in (0.05, 5.0))
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=1e-5)
    torch.testing.assert_close(images[3], images[2], rtol=0, atol=1e-5)
    assert float((images[1] - images[2]).abs().max()) > 0.1


def test_a_larger_cutoff_than_the_tables_is_refused(engine, rng):
    etsplat.register_kernel("mine", waves, x_max=1.5)
    scene = soup(rng, 5)
    with pytest.raises(ValueError, match=r"cutoffs\.x_max must be at most 1\.5 with kernel 'mine'"):
        render(scene, engine, kernel="mine")
    assert render(scene, engine, kernel="mine", cutoffs=etsplat.Cutoffs(x_max=1.5)).color.isfinite().all()


def test_unknown_kernels_are_named_with_the_registered_ones(engine, rng):
    etsplat.register_kernel("mine", waves)
    with pytest.raises(ValueError, match=r"kernel must be one of .*'hard', 'mine', got 'yours'"):
        render(soup(rng, 5), engine, kernel="yours")
