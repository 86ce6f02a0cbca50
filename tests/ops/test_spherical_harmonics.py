import math

import numpy as np
import pytest
import torch

from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.ops.spherical_harmonics import spherical_harmonics
from helpers.engines import on

DEGREES = [0, 1, 2, 3]


def problem(rng: torch.Generator, degree: int, points: int = 37, channels: int = 3, views: int | None = None):
    coefficients = 1.5 * torch.randn((points, (degree + 1) ** 2, channels), generator=rng)
    shape = (points, 3) if views is None else (views, points, 3)
    return coefficients, 3 * torch.randn(shape, generator=rng)


def gradients(coefficients, directions, degree, cotangent, engine=None):
    leaves = coefficients.clone().requires_grad_(), directions.clone().requires_grad_()
    colors = on(engine, spherical_harmonics, *leaves, degree)
    return colors.detach(), *torch.autograd.grad((colors * cotangent).sum(), leaves, materialize_grads=True)


def basis_values(directions: torch.Tensor, degree: int, engine: str) -> torch.Tensor:
    """Y_k at N directions (N, K): coefficients that pick one basis per channel, before the shift by 1/2."""
    bases = (degree + 1) ** 2
    picks = 0.1 * torch.eye(bases).expand(len(directions), bases, bases)
    return (on(engine, spherical_harmonics, picks, directions, degree) - 0.5) / 0.1


@pytest.mark.sanitize
@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("views", [None, 1, 3])
def test_every_engine_agrees_with_the_float64_reference(engine, rng, degree, views):
    """Colours and both gradients agree, for one and for several views, with clamped colours among them."""
    coefficients, directions = problem(rng, degree, views=views)
    cotangent = torch.randn((*directions.shape[:-1], 3), generator=rng)
    ours = gradients(coefficients, directions, degree, cotangent, engine)
    exact = gradients(coefficients.double(), directions.double(), degree, cotangent.double())
    assert bool((ours[0] == 0).any())
    for a, b in zip(ours, exact, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("degree", DEGREES)
def test_reference_passes_gradcheck(rng, degree):
    """Both gradients of the reference are those of finite differences."""
    coefficients, directions = (tensor.double().requires_grad_() for tensor in problem(rng, degree, points=4, views=2))
    assert torch.autograd.gradcheck(lambda c, d: spherical_harmonics(c, d, degree), (coefficients, directions))


def test_bases_are_orthonormal_on_the_sphere(engine):
    """Integrals of the products of two bases, by a quadrature exact to degree 6, form the identity."""
    heights, weights = np.polynomial.legendre.leggauss(8)
    angles = np.arange(16) * (2 * math.pi / 16)
    z, angle = (torch.tensor(grid.ravel()) for grid in np.meshgrid(heights, angles, indexing="ij"))
    ring = (1 - z**2).sqrt()
    directions = torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=1).float()
    values = basis_values(directions, 3, engine).double()
    area = torch.tensor(weights).repeat_interleave(16) * (2 * math.pi / 16)
    gram = values.T @ (area[:, None] * values)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=2e-5)


def test_each_band_is_rotation_invariant(engine, rng):
    """The squares of a band's bases sum to (2 l + 1) / (4 pi) in every direction (addition theorem)."""
    directions = torch.randn((50, 3), generator=rng)
    squares = basis_values(directions, 3, engine).square()
    for band in range(4):
        total = squares[:, band**2 : (band + 1) ** 2].sum(dim=1)
        torch.testing.assert_close(total, torch.full((50,), (2 * band + 1) / (4 * math.pi)), rtol=1e-4, atol=1e-5)


def test_order_and_sign_are_those_of_gaussian_splatting(engine):
    """Bands 0 and 1 are c0, -y, z, -x; the bases along the axes have the published values."""
    values = basis_values(torch.eye(3), 3, engine)
    assert values[0, 3] == pytest.approx(-0.4886025, abs=1e-5)
    assert values[1, 1] == pytest.approx(-0.4886025, abs=1e-5)
    assert values[2, 2] == pytest.approx(0.4886025, abs=1e-5)
    assert values[0, 8] == pytest.approx(0.5462742, abs=1e-5)
    assert values[2, 6] == pytest.approx(2 * 0.3153916, abs=1e-5)
    assert values[1, 9] == pytest.approx(0.5900436, abs=1e-5)
    assert values[0, 15] == pytest.approx(-0.5900436, abs=1e-5)
    diagonal = basis_values(torch.tensor([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0]]), 2, engine)
    assert diagonal[0, 4] == pytest.approx(1.0925484 / 2, abs=1e-5)
    assert diagonal[1, 5] == pytest.approx(-1.0925484 / 2, abs=1e-5)


def test_directions_need_not_be_normalised(engine, rng):
    """Colours do not depend on the length of a direction, and the gradient has no radial part."""
    coefficients, directions = problem(rng, 3)
    cotangent = torch.randn((37, 3), generator=rng)
    colors, _, grad = gradients(coefficients, directions, 3, cotangent, engine)
    scaled = on(engine, spherical_harmonics, coefficients, 7 * directions, 3)
    torch.testing.assert_close(colors, scaled, rtol=1e-5, atol=1e-5)
    assert float((grad * directions).sum(dim=1).abs().max()) < 1e-4


@pytest.mark.sanitize
def test_zero_length_direction_shows_the_constant_band(engine, rng):
    """No NaN: the colour is that of degree 0, the gradient goes to the constant coefficient alone."""
    coefficients, _ = problem(rng, 3, points=2)
    coefficients[:, 0] = 1.0
    directions = torch.tensor([[0.0, 0.0, 0.0], [1e-20, 0.0, -1e-25]])
    colors, grad_c, grad_d = gradients(coefficients, directions, 3, torch.ones(2, 3), engine)
    torch.testing.assert_close(colors, torch.full((2, 3), 0.5 + 0.28209479))
    assert float(grad_d.abs().max()) == 0
    assert float(grad_c[:, 1:].abs().max()) == 0
    torch.testing.assert_close(grad_c[:, 0], torch.full((2, 3), 0.28209479))


def test_no_gradient_where_clamped(engine, rng):
    """A colour below zero is shown as zero and moves nothing."""
    coefficients, directions = problem(rng, 3)
    coefficients[:, 0] = -30
    colors, grad_c, grad_d = gradients(coefficients, directions, 3, torch.ones(37, 3), engine)
    assert float(colors.abs().max()) == 0
    assert float(grad_c.abs().max()) == 0
    assert float(grad_d.abs().max()) == 0


def test_unused_bands_get_zero_gradient(engine, rng):
    """With coefficients of degree 3, a lower degree reads and moves its own bands only."""
    coefficients, directions = problem(rng, 3)
    cotangent = torch.ones(37, 3)
    colors, grad_c, grad_d = gradients(coefficients, directions, 1, cotangent, engine)
    own = gradients(coefficients[:, :4], directions, 1, cotangent, engine)
    torch.testing.assert_close(colors, own[0])
    torch.testing.assert_close(grad_c[:, :4], own[1])
    torch.testing.assert_close(grad_d, own[2])
    assert float(grad_c[:, 4:].abs().max()) == 0


@pytest.mark.sanitize
def test_same_bits_for_any_number_of_threads(rng):
    """Sums over views are taken per point, in order."""
    coefficients, directions = problem(rng, 3, points=3001, channels=5, views=3)
    cotangent = torch.randn((3, 3001, 5), generator=rng)
    before = num_threads()
    results = []
    for count in (1, 2, 5):
        set_num_threads(count)
        results.append(gradients(coefficients, directions, 3, cotangent))
    set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.sanitize
def test_empty_and_non_contiguous(rng):
    """No points or no views are no error; strided input gives the result of its contiguous copy."""
    assert spherical_harmonics(torch.zeros(0, 4, 3), torch.zeros(0, 3), 1).shape == (0, 3)
    assert spherical_harmonics(torch.zeros(5, 4, 3), torch.zeros(0, 5, 3), 1).shape == (0, 5, 3)
    coefficients, directions = problem(rng, 2)
    strided = coefficients.transpose(0, 2).contiguous().transpose(0, 2), directions.T.contiguous().T
    cotangent = torch.ones(1, 1).expand(37, 3)
    for a, b in zip(gradients(*strided, 2, cotangent), gradients(coefficients, directions, 2, cotangent), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"degree": 4}, "degree must be an integer from 0 to 3, got 4"),
        ({"degree": 1.0}, r"degree must be an integer from 0 to 3, got 1\.0"),
        ({"coefficients": torch.zeros(5, 4, 3)}, "coefficients"),
        ({"coefficients": torch.zeros(5, 9)}, "coefficients"),
        ({"directions": torch.zeros(4, 3)}, "directions"),
        ({"directions": torch.zeros(5, 3).double()}, "directions"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    """Each wrong argument is a ValueError that names it."""
    arguments = {"coefficients": torch.zeros(5, 9, 3), "directions": torch.ones(5, 3), "degree": 2, **change}
    with pytest.raises(ValueError, match=message):
        spherical_harmonics(**arguments)
