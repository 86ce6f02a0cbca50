import numpy as np
import pytest
import torch
from torch import Tensor

from etsplat.metrics.flip import flip
from helpers.torch_threads import on_each_count


def picture(index: int, height: int, width: int) -> np.ndarray:
    """Smooth waves in all three channels."""
    y, x = np.mgrid[0:height, 0:width] / 20.0
    waves = np.stack([np.sin(3 * x + y + index), np.cos(2 * x - 4 * y), np.sin(5 * y * x)], axis=-1)
    return waves / 2 + 0.5


def pairs() -> list[tuple[Tensor, Tensor]]:
    """Noise, another contrast, a shift of two pixels, and noise alone, beside such pictures; as float32 holds them."""
    noise = [np.random.RandomState(seed) for seed in range(4)]
    truths = [picture(index, *size) for index, size in enumerate([(48, 64), (40, 30), (75, 100), (20, 120)])]
    images = [
        np.clip(truths[0] + 0.1 * noise[0].randn(48, 64, 3), 0, 1),
        0.8 * truths[1] + 0.1,
        np.roll(truths[2], 2, axis=1),
        noise[3].rand(20, 120, 3),
    ]
    as_float = [[torch.from_numpy(each.astype(np.float32)) for each in pictures] for pictures in (images, truths)]
    return list(zip(*as_float, strict=True))


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (0, (0.18514780700206757, 0.2957482933998108)),
        (1, (0.3637809753417969, 0.3620467782020569)),
        (2, (0.43515563011169434, 0.5200208425521851)),
        (3, (0.8923786282539368, 0.8819307684898376)),
    ],
)
def test_flip_agrees_with_its_authors_program(index, expected):
    """At 67 and 30 pixels per degree; what flip-evaluator 1.7 says of them (in float32)."""
    image, truth = pairs()[index]
    for pixels_per_degree, value in zip((67.0, 30.0), expected, strict=True):
        ours = flip(image.double(), truth.double(), pixels_per_degree=pixels_per_degree)
        assert float(ours) == pytest.approx(value, abs=2e-6)
        assert float(flip(image, truth, pixels_per_degree=pixels_per_degree)) == pytest.approx(float(ours), abs=1e-6)


def test_gradients_are_those_of_finite_differences_and_0_for_equal_pictures(rng):
    truth = torch.rand(9, 12, 3, generator=rng, dtype=torch.float64)
    image = (0.9 * truth + 0.05).requires_grad_()
    assert torch.autograd.gradcheck(lambda image: flip(image, truth), (image,), eps=1e-7, atol=1e-6)
    same = truth.clone().requires_grad_()
    value = flip(same, truth)
    value.backward()
    assert value.item() == 0
    assert same.grad is not None
    assert not same.grad.any()


def test_flip_is_1_between_the_farthest_colours_and_symmetric():
    """Green and blue, which the ranges are made for; and the order of the pictures does not matter."""
    green, blue = (torch.tensor(color).expand(12, 10, 3) for color in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    assert float(flip(green, blue)) == pytest.approx(1, abs=1e-4)
    image, truth = pairs()[0]
    assert float(flip(image, truth)) == pytest.approx(float(flip(truth, image)), abs=1e-7)


def test_bad_arguments_are_named():
    image = torch.zeros(4, 5, 3)
    with pytest.raises(ValueError, match=r"image: expected shape \(H, W, 3\)"):
        flip(image[..., :1], image[..., :1])
    with pytest.raises(ValueError, match="truth: expected the image's shape"):
        flip(image, image[1:])
    with pytest.raises(ValueError, match="image must be of floating-point numbers"):
        flip(image.byte(), image)
    with pytest.raises(ValueError, match="truth must be of floating-point numbers"):
        flip(image, image.bool())
    with pytest.raises(ValueError, match=r"image: expected a pixel or more, got shape \(0, 5, 3\)"):
        flip(image[:0], image[:0])
    with pytest.raises(ValueError, match=r"truth: expected values in \[0, 1\], got others; divide by 255"):
        flip(image, image + 255)
    with pytest.raises(ValueError, match="pixels_per_degree: expected a positive number, got 0"):
        flip(image, image, pixels_per_degree=0.0)


def test_what_is_no_number_is_no_likeness_and_half_precision_no_difference(rng):
    image, truth = torch.rand(2, 16, 16, 3, generator=rng)
    spoilt = image.clone()
    spoilt[3, 3] = torch.nan
    assert bool(flip(spoilt, truth).isnan())
    assert float(flip(image.half(), truth.half())) == pytest.approx(float(flip(image, truth)), abs=1e-3)


def test_equal_bits_on_any_number_of_torchs_threads(rng):
    """Of pictures large enough that torch shares their sums and powers out."""
    image, truth = (torch.rand(401, 403, 3, generator=rng) for _ in range(2))
    assert len(set(on_each_count(lambda: float(flip(image, truth))))) == 1
