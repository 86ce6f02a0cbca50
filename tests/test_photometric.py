import pytest
import torch

from etsplat.ops.engines import num_threads, set_num_threads
from etsplat.ops.photometric import l1_over_background


def scene(rng: torch.Generator, views: int, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    color = torch.rand((views, height, width, 3), generator=rng)
    alpha = torch.rand((views, height, width, 1), generator=rng)
    rgb = torch.rand((views, height, width, 3), generator=rng) * alpha
    return color, torch.cat([rgb, alpha], dim=-1), torch.rand((views, 3), generator=rng)


def value_and_gradient(color, target, backgrounds, engine=None):
    leaf = color.clone().requires_grad_()
    loss = l1_over_background(leaf, target, backgrounds, engine=engine)
    loss.backward()
    return loss.detach(), leaf.grad


@pytest.mark.sanitize
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 33, 47), (3, 5, 1000), (1, 64, 64)])
def test_native_agrees_with_float64_reference(rng, shape):
    """Value and gradient agree at odd sizes, several views and fewer pixels than a block."""
    color, target, backgrounds = scene(rng, *shape)
    loss, gradient = value_and_gradient(color, target, backgrounds)
    exact, exact_gradient = value_and_gradient(color.double(), target.double(), backgrounds.double())
    assert float(loss) == pytest.approx(float(exact), rel=1e-6)
    torch.testing.assert_close(gradient.double(), exact_gradient, rtol=1e-6, atol=0)


def test_reference_passes_gradcheck(rng):
    """The gradient of the reference is that of finite differences away from the kink."""
    color, target, backgrounds = (tensor.double() for tensor in scene(rng, 1, 3, 4))
    assert torch.autograd.gradcheck(lambda c: l1_over_background(c, target, backgrounds), color.requires_grad_())


def test_equal_images_have_zero_loss_and_gradient(engine, rng):
    """A picture composited over the background is at the minimum, where the gradient is zero."""
    _, target, backgrounds = scene(rng, 2, 9, 7)
    composited = target[..., :3] + (1 - target[..., 3:]) * backgrounds[:, None, None]
    loss, gradient = value_and_gradient(composited, target, backgrounds, engine)
    assert float(loss) == 0
    assert float(gradient.abs().max()) == 0


def test_black_image_over_a_transparent_target_gives_the_mean_background(engine):
    """Where the target is empty the loss is the background's brightness."""
    backgrounds = torch.tensor([[0.2, 0.4, 0.9]])
    loss = l1_over_background(torch.zeros(1, 8, 8, 3), torch.zeros(1, 8, 8, 4), backgrounds, engine=engine)
    assert float(loss) == pytest.approx(0.5, rel=1e-6)


@pytest.mark.sanitize
def test_same_bits_for_any_number_of_threads(rng):
    """The sum is taken in a fixed order."""
    arguments = scene(rng, 2, 301, 203)
    before = num_threads()
    results = []
    for count in (1, 2, 5):
        set_num_threads(count)
        results.append(value_and_gradient(*arguments))
    set_num_threads(before)
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_gradient_scales_with_the_objective_and_survives_a_second_backward(rng):
    """A weight on the loss scales the stored gradient, which a repeated backward finds unchanged."""
    color, target, backgrounds = scene(rng, 1, 20, 30)
    _, unit = value_and_gradient(color, target, backgrounds)
    leaf = color.clone().requires_grad_()
    loss = l1_over_background(leaf, target, backgrounds)
    for _ in range(2):
        loss.backward(retain_graph=True)
    (0.5 * loss).backward()
    torch.testing.assert_close(leaf.grad, 2.5 * unit)


def test_non_contiguous_input_is_read_correctly(rng):
    """Channel-first storage gives the loss of its contiguous copy."""
    color, target, backgrounds = scene(rng, 1, 10, 11)
    strided = [t.movedim(-1, 1).contiguous().movedim(1, -1) for t in (color, target)]
    assert torch.equal(l1_over_background(*strided, backgrounds), l1_over_background(color, target, backgrounds))


@pytest.mark.parametrize("name", ["color", "target", "backgrounds"])
def test_wrong_shapes_are_named(name):
    """Each wrong shape is a ValueError that names the argument."""
    arguments = {
        "color": torch.rand(2, 4, 4, 3),
        "target": torch.rand(2, 4, 4, 4),
        "backgrounds": torch.rand(2, 3),
        name: torch.rand(2, 4, 4, 5),
    }
    with pytest.raises(ValueError, match=name):
        l1_over_background(**arguments)


def test_constants_that_want_a_gradient_are_refused(rng):
    """A target or background cannot silently lose its gradient."""
    color, target, backgrounds = scene(rng, 1, 4, 4)
    with pytest.raises(ValueError, match="target"):
        l1_over_background(color, target.requires_grad_(), backgrounds)
    with pytest.raises(ValueError, match="color"):
        l1_over_background(color[:, :0], target[:, :0].detach(), backgrounds)
