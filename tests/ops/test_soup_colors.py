import pytest
import torch

from etsplat import _native
from etsplat.ops.soup_colors import soup_colors
from etsplat.ops.spherical_harmonics import spherical_harmonics
from helpers.engines import on


def problem(rng: torch.Generator, triangles: int, views: int, bases: int = 15):
    vertices = torch.randn((triangles, 3, 3), generator=rng)
    dc = torch.randn((triangles, 1, 3), generator=rng)
    rest = 0.5 * torch.randn((triangles, bases, 3), generator=rng)
    return vertices, dc, rest, torch.randn((views, 3), generator=rng)


def gradients(inputs, degree, cotangent, engine):
    leaves = [tensor.clone().requires_grad_() for tensor in inputs[:3]]
    colors = on(engine, soup_colors, *leaves, inputs[3], degree)
    colors.backward(cotangent)
    return colors.detach(), [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]


@pytest.mark.sanitize
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_engine_agrees_with_the_float64_reference(engine, rng, degree):
    """Colours and all gradients, also with more bands than any degree has, and many triangles that no view sees."""
    inputs = problem(rng, 700, 2, bases=17)
    cotangent = torch.randn((2, 700, 3), generator=rng)
    cotangent[0, ::3] = 0
    cotangent[:, :200] = 0
    colors, grads = gradients(inputs, degree, cotangent, engine)
    exact, exact_grads = gradients([t.double() for t in inputs], degree, cotangent.double(), "reference")
    torch.testing.assert_close(colors.double(), exact, rtol=1e-5, atol=2e-6)
    clamp = (exact.abs() < 1e-5).any(dim=-1).any(dim=0)  # float32 may clamp where float64 does not
    for grad, exact_grad in zip(grads, exact_grads, strict=True):
        scale = float(exact_grad.abs().max())
        torch.testing.assert_close(grad.double()[~clamp], exact_grad[~clamp], rtol=1e-4, atol=1e-6 * scale)


@pytest.mark.sanitize
@pytest.mark.parametrize("instruction_set", _native.available_instruction_sets())
@pytest.mark.parametrize(("degree", "bases"), [(0, 0), (0, 15), (1, 3), (1, 15), (2, 8), (3, 15)])
def test_a_triangle_has_the_same_bits_alone_as_among_others(rng, instruction_set, degree, bases):
    """Sixteen are in the lanes of a vector, the last of these many are not; some no view sees, one has no direction."""
    vertices, dc, rest, centers = problem(rng, 37, 2, bases)
    vertices[4] = centers[0]
    cotangent = torch.randn((2, 37, 3), generator=rng)
    cotangent[0, ::3] = 0
    cotangent[:, 5:9] = 0
    cotangent[1, 10] = torch.nan
    before = _native.instruction_set()
    _native.set_instruction_set(instruction_set)
    try:
        colors, grads = gradients((vertices, dc, rest, centers), degree, cotangent, "cpu")
        each = [(vertices[i : i + 1], dc[i : i + 1], rest[i : i + 1], centers) for i in range(37)]
        alone = [gradients(one, degree, cotangent[:, i : i + 1], "cpu") for i, one in enumerate(each)]
    finally:
        _native.set_instruction_set(before)
    torch.testing.assert_close(colors, torch.cat([one[0] for one in alone], dim=1), rtol=0, atol=0)
    for grad, parts in zip(grads, zip(*(one[1] for one in alone), strict=True), strict=True):
        torch.testing.assert_close(grad, torch.cat(parts), rtol=0, atol=0, equal_nan=True)


def test_direction_is_from_the_camera_to_the_centroid(engine, rng):
    """The colours are the spherical harmonics of that direction."""
    vertices, dc, rest, centers = problem(rng, 20, 1)
    expected = spherical_harmonics(torch.cat([dc, rest], dim=1), vertices.mean(dim=1) - centers, 3)
    torch.testing.assert_close(on(engine, soup_colors, vertices, dc, rest, centers, 3)[0], expected)


def test_camera_at_the_centroid_sees_the_constant_band(engine, rng):
    """Without a direction there is neither NaN nor a gradient to the corners."""
    _, dc, rest, _ = problem(rng, 1, 1)
    vertices, centers = torch.tensor([[[1.0, 0, 0], [-1, 1, 0], [0, -1, 0]]]), torch.zeros(1, 3)
    colors, grads = gradients((vertices, dc, rest, centers), 3, torch.ones(1, 1, 3), engine)
    torch.testing.assert_close(colors[0], (0.5 + 0.28209479 * dc[:, 0]).clamp_min(0), rtol=1e-4, atol=1e-5)
    assert bool(grads[0].isfinite().all())


def test_wrong_arguments_are_named(rng):
    """A wrong shape or degree is a ValueError that names the argument."""
    vertices, dc, rest, centers = problem(rng, 4, 1, bases=8)
    with pytest.raises(ValueError, match="sh_rest"):
        soup_colors(vertices, dc, rest, centers, 3)
    with pytest.raises(ValueError, match="degree"):
        soup_colors(vertices, dc, rest, centers, 4)
    with pytest.raises(ValueError, match="centers"):
        soup_colors(vertices, dc, rest, centers.double(), 1)


@pytest.mark.parametrize("views", [1, 3])
def test_cameras_get_the_gradient_of_where_they_are(engine, rng, views):
    """As finite differences in float64 have it; without a wish for it colours have the same bits as ever."""
    inputs = problem(rng, 40, views)
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    colors = on(engine, soup_colors, *leaves, 2)
    torch.testing.assert_close(colors.detach(), on(engine, soup_colors, *inputs, 2), rtol=1e-4, atol=1e-5)
    weights = torch.randn(colors.shape, generator=rng)
    colors.backward(weights)
    exact = [tensor.double() for tensor in inputs]
    move = torch.zeros_like(exact[3])
    for index in range(move.numel()):
        move.flatten()[index] = 1e-6
        ahead, behind = (soup_colors(*exact[:3], exact[3] + sign * move, 2) for sign in (1, -1))
        found = float((weights * (ahead - behind)).sum() / 2e-6)
        move.zero_()
        assert float(leaves[3].grad.flatten()[index]) == pytest.approx(found, rel=2e-3, abs=2e-3)
