import pytest
import torch

from etsplat import _native
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.metrics.image import ssim
from etsplat.ops.photometric import photometric_loss
from helpers.engines import on


def pair(rng: torch.Generator, views: int, height: int, width: int, channels: int = 3):
    """A rendering, and a target in bytes that resembles it."""
    color = torch.rand((views, height, width, 3), generator=rng)
    near = (color + 0.2 * torch.randn(color.shape, generator=rng)).clamp(0, 1)
    alpha = torch.rand((views, height, width, 1), generator=rng)
    target = torch.cat([near * alpha, alpha], dim=-1) if channels == 4 else near
    return color, (255 * target).round().to(torch.uint8)


def value_and_gradient(color, target, weight, mask=None, engine=None, **options):
    leaf = color.clone().requires_grad_()
    loss = on(engine, photometric_loss, leaf, target, weight, mask, **options)
    loss.backward()
    return loss.detach(), leaf.grad


@pytest.mark.sanitize
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 33, 47), (1, 7, 130), (1, 70, 9)])
@pytest.mark.parametrize("pixel", ["l1", "l2"])
@pytest.mark.parametrize("channels", [3, 4])
def test_every_engine_agrees_with_the_float64_reference(engine, rng, shape, pixel, channels):
    """Value and gradient agree at sizes below the window and across bands, with and without alpha and mask."""
    color, target = pair(rng, *shape, channels)
    backgrounds = torch.rand((shape[0], 3), generator=rng)
    mask = torch.rand(shape, generator=rng)
    for weight, given in ((0.2, None), (0.4, mask), (0.0, None), (0.0, mask), (1.0, None)):
        loss, gradient = value_and_gradient(color, target, weight, given, engine, backgrounds=backgrounds, pixel=pixel)
        exact, exact_gradient = value_and_gradient(
            color.double(),
            target,
            weight,
            None if given is None else given.double(),
            backgrounds=backgrounds.double(),
            pixel=pixel,
        )
        assert float(loss) == pytest.approx(float(exact), rel=1e-5)
        scale = float(exact_gradient.abs().max())
        torch.testing.assert_close(gradient.double(), exact_gradient, rtol=1e-4, atol=1e-5 * scale)


def test_reference_passes_gradcheck(rng):
    """The gradient of the reference is that of finite differences."""
    color, target = pair(rng, 1, 4, 5)
    mask = torch.rand((1, 4, 5), generator=rng, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda c: photometric_loss(c, target, 0.3, mask, pixel="l2"), color.double().requires_grad_()
    )


def test_black_image_over_a_transparent_target_gives_the_mean_background(engine):
    """Where the target is empty the pixel term is the background's brightness."""
    backgrounds = torch.tensor([[0.2, 0.4, 0.9]])
    empty = torch.zeros(1, 8, 8, 3), torch.zeros(1, 8, 8, 4)
    assert float(on(engine, photometric_loss, *empty, 0.0, backgrounds=backgrounds)) == pytest.approx(0.5, rel=1e-6)


def test_equal_images_have_zero_loss_and_gradient(engine, rng):
    """A picture composited over the background is at the minimum, where the pixel term's gradient is zero."""
    _, target = pair(rng, 2, 9, 7, channels=4)
    target, backgrounds = target / 255, torch.rand((2, 3), generator=rng)
    composited = target[..., :3] + (1 - target[..., 3:]) * backgrounds[:, None, None]
    loss, gradient = value_and_gradient(composited, target, 0.0, backgrounds=backgrounds, engine=engine)
    assert float(loss) == 0
    assert float(gradient.abs().max()) == 0


def test_structural_part_is_the_metric(engine, rng):
    """At weight 1 the loss is 1 - SSIM as the zero-padded metric measures it."""
    color, target = pair(rng, 1, 40, 30)
    loss = on(engine, photometric_loss, color, target, 1.0)
    assert float(loss) == pytest.approx(1 - ssim(color[0], target[0] / 255), abs=1e-5)


def test_bytes_and_floats_give_the_same_loss(engine, rng):
    """A target in bytes is its value over 255."""
    color, target = pair(rng, 1, 20, 30)
    losses = [on(engine, photometric_loss, color, t, 0.2) for t in (target, target / 255)]
    assert float(losses[0]) == pytest.approx(float(losses[1]), rel=1e-6)


def test_masked_pixels_have_no_say(engine, rng):
    """What is drawn where the mask is 0 changes neither the loss nor gets a gradient."""
    color, target = pair(rng, 1, 30, 40)
    mask = torch.ones(1, 30, 40)
    mask[:, 10:20, 5:25] = 0
    other = torch.where(mask[..., None] > 0, color, torch.rand(color.shape, generator=rng))
    loss, gradient = value_and_gradient(color, target, 0.2, mask, engine=engine)
    same, _ = value_and_gradient(other, target, 0.2, mask, engine=engine)
    assert torch.equal(loss, same)
    assert float(gradient[mask == 0].abs().max()) == 0


@pytest.mark.sanitize
@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_same_bits_for_any_number_of_threads(rng, weight):
    """Bands are added in a fixed order."""
    color, target = pair(rng, 2, 101, 53)
    before = num_threads()
    results = []
    for count in (1, 2, 5):
        set_num_threads(count)
        results.append(value_and_gradient(color, target, weight))
    set_num_threads(before)
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_instruction_sets_agree(rng):
    """Every compiled path gives the same loss and gradient to rounding."""
    color, target = pair(rng, 1, 50, 61)
    results = []
    for name in _native.available_instruction_sets():
        _native.set_instruction_set(name)
        results.append(value_and_gradient(color, target, 0.2))
    _native.set_instruction_set("")
    for loss, gradient in results[1:]:
        assert float(loss) == pytest.approx(float(results[0][0]), rel=1e-6)
        torch.testing.assert_close(gradient, results[0][1], rtol=1e-4, atol=1e-8)


def test_gradient_scales_with_the_objective_and_survives_a_second_backward(rng):
    """A weight on the loss scales the stored gradient, which a repeated backward finds unchanged."""
    color, target = pair(rng, 1, 20, 30)
    _, unit = value_and_gradient(color, target, 0.2)
    leaf = color.clone().requires_grad_()
    loss = photometric_loss(leaf, target, 0.2)
    for _ in range(2):
        loss.backward(retain_graph=True)
    (0.5 * loss).backward()
    torch.testing.assert_close(leaf.grad, 2.5 * unit)


def test_non_contiguous_input_is_read_correctly(rng):
    """Channel-first storage gives the loss of its contiguous copy."""
    pictures = pair(rng, 1, 10, 11)
    strided = [picture.movedim(-1, 1).contiguous().movedim(1, -1) for picture in pictures]
    assert torch.equal(photometric_loss(*strided, 0.2), photometric_loss(*pictures, 0.2))


def test_wrong_arguments_are_named(rng):
    """Shapes, dtypes and ranges are checked before anything is read."""
    color, target = pair(rng, 1, 8, 9)
    with pytest.raises(ValueError, match="target"):
        photometric_loss(color, target[..., :2], 0.2)
    with pytest.raises(ValueError, match="target"):
        photometric_loss(color, target.double(), 0.2)
    with pytest.raises(ValueError, match="mask"):
        photometric_loss(color, target, 0.2, torch.ones(1, 9, 8))
    with pytest.raises(ValueError, match="backgrounds"):
        photometric_loss(color, target, 0.2, backgrounds=torch.ones(4))
    for weight, message in ((1.2, "from 0 to 1, got 1.2"), ("x", "a number, got 'x'"), (float("nan"), "from 0 to 1")):
        with pytest.raises(ValueError, match=f"dssim_weight must be {message}"):
            photometric_loss(color, target, weight)
    with pytest.raises(ValueError, match="color"):
        photometric_loss(color[:, :0], target[:, :0], 0.2)
    with pytest.raises(ValueError, match="target"):
        photometric_loss(color, (target / 255).requires_grad_(), 0.2)
