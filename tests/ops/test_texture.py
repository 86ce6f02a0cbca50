"""Sampling of textures: values, gradients, levels, the same bits."""

import math

import pytest
import torch
from torch import Tensor

from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.ops.texture import count_levels, sample_texture
from helpers.engines import dtype_of, on
from helpers.tolerances import assert_close_to_scale

pytestmark = pytest.mark.sanitize


def gradients(engine: str, texture: Tensor, uv: Tensor, cotangent: Tensor, **options: Tensor | int) -> list[Tensor]:
    dtype = dtype_of(engine)
    leaves = [tensor.detach().to(dtype).requires_grad_() for tensor in (texture, uv)]
    given = {name: value.to(dtype) if isinstance(value, Tensor) else value for name, value in options.items()}
    values = on(engine, sample_texture, *leaves, **given)
    (values * cotangent.to(values)).sum().backward()
    return [values.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("levels", ["one", "two", "all"])
def test_native_agrees_with_the_reference(engine, rng, levels, channels):
    """Values and both gradients, of samples in several tiles of texels, between levels, and beyond the border."""
    texture = torch.rand(96, 160, channels, generator=rng)
    uv, cotangent = 1.2 * torch.rand(40, 50, 2, generator=rng) - 0.1, torch.randn(40, 50, channels, generator=rng)
    lod = 9 * torch.rand(40, 50, generator=rng) - 1
    options = {"one": {}, "two": {"lod": lod, "max_level": 1}, "all": {"lod": lod}}[levels]
    native, exact = (gradients(name, texture, uv, cotangent, **options) for name in (engine, "reference"))
    for name, one, other in zip(("values", "texture", "uv"), native, exact, strict=True):
        assert_close_to_scale(one, other, 1e-4, name=name)  # places in float32 are off by 160 / 2^24 of a texel


def test_places_are_those_of_gltf(engine):
    """Texel (row, column) has its centre at ((column + 1/2) / W, (row + 1/2) / H); between two it is their mean."""
    texture = torch.arange(6.0, dtype=dtype_of(engine)).view(2, 3, 1)
    uv = torch.tensor([[1 / 6, 0.25], [5 / 6, 0.25], [1 / 6, 0.75], [0.5, 0.5], [0.0, 0.0], [1.0, 1.0], [9.0, -9.0]])
    values = on(engine, sample_texture, texture, uv.to(texture))[:, 0]
    torch.testing.assert_close(values.float(), torch.tensor([0.0, 2.0, 3.0, 2.5, 0.0, 5.0, 2.0]))


def test_levels_are_means(engine, rng):
    """At level 1 a centre has the mean of its four texels, at 1.5 half of that of all; levels end at max_level."""
    texture = torch.rand(4, 4, 2, generator=rng).to(dtype_of(engine))
    uv = torch.tensor([[0.25, 0.75]]).to(texture)
    four, every = texture[2:, :2].mean(dim=(0, 1)), texture.mean(dim=(0, 1))
    for lod, most, expected in (
        (1, None, four),
        (1.5, None, (four + every) / 2),
        (7, None, every),
        (7, 1, four),
    ):
        found = on(engine, sample_texture, texture, uv, lod=torch.full((1,), float(lod)).to(texture), max_level=most)
        torch.testing.assert_close(found[0], expected)


def test_levels_end_where_a_side_is_odd():
    sizes = [(8, 8), (12, 8), (5, 8), (1, 1)]
    assert [count_levels(torch.zeros(*size, 1), None) for size in sizes] == [4, 3, 1, 1]
    assert count_levels(torch.zeros(8, 8, 1), 2) == 3


def test_gradients_are_finite_differences(rng):
    """Of the reference, in float64, between levels too."""
    texture = torch.rand(4, 6, 2, generator=rng, dtype=torch.float64).requires_grad_()
    uv = torch.rand(7, 2, generator=rng, dtype=torch.float64).requires_grad_()
    lod = 2 * torch.rand(7, generator=rng, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda t, places: sample_texture(t, places, lod=lod), (texture, uv))


def test_a_crowded_texel_gets_all_its_gradients(engine):
    """200,000 samples of one texel, more than are added up at once; the others get none."""
    count = 200_000 if engine == "cpu" else 20_000
    texture = torch.zeros(128, 128, 1, dtype=dtype_of(engine)).requires_grad_()
    uv = torch.full((count, 2), 70.5 / 128, dtype=texture.dtype)
    on(engine, sample_texture, texture, uv).sum().backward()
    expected = torch.zeros(128, 128)
    expected[70, 70] = count
    assert texture.grad is not None
    torch.testing.assert_close(texture.grad[..., 0].float(), expected)


def test_same_bits_for_any_number_of_threads(rng):
    """Values and gradients, of samples in several chunks."""
    texture, uv = torch.rand(256, 192, 3, generator=rng), torch.rand(50_000, 2, generator=rng)
    cotangent, lod = torch.randn(50_000, 3, generator=rng), 5 * torch.rand(50_000, generator=rng)
    before, results = num_threads(), []
    for count in (1, 2, 5):
        set_num_threads(count)
        results.append(gradients("cpu", texture, uv, cotangent, lod=lod))
    set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(one, other) for one, other in zip(result, results[0], strict=True))


def test_runs_on_the_gpu_engine_have_the_same_bits(cuda_engine, rng):
    texture, uv = torch.rand(16, 16, 3, generator=rng), torch.rand(3000, 2, generator=rng)
    cotangent, lod = torch.randn(3000, 3, generator=rng), 5 * torch.rand(3000, generator=rng)
    first, second = (gradients(cuda_engine, texture, uv, cotangent, lod=lod) for _ in range(2))
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))


def test_what_is_not_finite_counts_as_the_border(engine):
    """NaN is 0, infinities are the ends; places there have no gradient, and the texture's stay finite."""
    texture = torch.arange(4.0, dtype=dtype_of(engine)).view(2, 2, 1).requires_grad_()
    uv = torch.tensor([[math.nan, 0.0], [math.inf, 0.0], [-math.inf, math.inf]], dtype=texture.dtype).requires_grad_()
    lod = torch.tensor([math.nan, -math.inf, 0.0], dtype=texture.dtype)
    values = on(engine, sample_texture, texture, uv, lod=lod)
    assert values[:, 0].tolist() == [0, 1, 2]
    values.sum().backward()
    assert texture.grad is not None
    assert uv.grad is not None
    assert texture.grad[..., 0].tolist() == [[1, 1], [1, 0]]
    assert uv.grad.tolist() == [[0, 0]] * 3


def test_no_samples_give_no_values(engine):
    texture = torch.rand(4, 4, 3, dtype=dtype_of(engine)).requires_grad_()
    values = on(engine, sample_texture, texture, texture.new_zeros(0, 5, 2))
    assert values.shape == (0, 5, 3)
    values.sum().backward()
    assert texture.grad is not None
    assert float(texture.grad.abs().max()) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"texture": torch.zeros(3, 3)}, "texture must have shape"),
        ({"texture": torch.zeros(0, 3, 3)}, "texture must have a texel"),
        ({"uv": torch.zeros(5, 3)}, "uv must have shape"),
        ({"uv": torch.tensor(0.5)}, "uv must have shape"),
        ({"uv": torch.zeros(5, 2).double()}, "uv must be torch.float32"),
        ({"lod": torch.zeros(4)}, "lod must have shape"),
        ({"lod": torch.zeros(5), "max_level": -1}, "max_level must be an integer of at least 0"),
        ({"max_level": 3}, "max_level must be None without lod"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        sample_texture(**{"texture": torch.zeros(4, 4, 3), "uv": torch.zeros(5, 2), **change})
