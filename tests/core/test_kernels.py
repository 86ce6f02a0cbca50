"""The kernel registry against the closed forms of the paper and of design section 4."""

import math

import pytest
import torch

from etsplat.core.kernels import KERNELS, RIM_FLOOR, X_FLOOR

SIGMAS = (0.02, 0.1, 0.32, 0.5, 1.0, 1.16, 2.0, 3.0)
SMOOTH = ("single_sided", "bilateral", "elastic")


def f64(value) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def paper_value(kernel: str, x: float, sigma: float) -> float:
    return {
        "single_sided": lambda: max(1 - x, 0.0) ** sigma,
        "bilateral": lambda: math.exp(-0.5 * x ** (2 / sigma)),
        "elastic": lambda: math.exp(-sigma * x ** (2 / sigma)),
        "hard": lambda: float(x <= 1),
    }[kernel]()


def test_native_ids_are_the_positions_in_the_registry():
    assert list(KERNELS) == ["single_sided", "bilateral", "elastic", "hard"]
    assert all(name == kernel.name for name, kernel in KERNELS.items())


@pytest.mark.parametrize("sigma", SIGMAS)
def test_value_is_the_papers_formula(kernel, sigma):
    for x in (0.001, 0.25, 0.7, 0.99, 1.0, 1.2, 2.0):
        assert float(KERNELS[kernel].value(f64(x), f64(sigma))) == pytest.approx(
            paper_value(kernel, x, sigma), abs=1e-12
        )


@pytest.mark.parametrize("sigma", SIGMAS)
def test_value_starts_at_one_falls_and_stays_in_the_unit_interval(kernel, sigma):
    value = KERNELS[kernel].value(torch.linspace(0, 3, 1000, dtype=torch.float64), f64(sigma))
    assert float(value[0]) == pytest.approx(1.0, abs=1.01 * max(sigma, 1.0) * X_FLOOR ** min(2 / sigma, 1.0))
    assert (value.diff() <= 0).all()
    assert (value >= 0).all()


@pytest.mark.parametrize("sigma", SIGMAS)
def test_derivatives_are_those_of_the_value(kernel, sigma):
    """Central differences agree at 40 distances on both sides of the edge."""
    function, step = KERNELS[kernel], 1e-6
    x = torch.cat([torch.linspace(0.02, 0.97, 20), torch.linspace(1.03, 2.0, 20)]).double()
    s = f64(sigma)
    dx = (function.value(x + step, s) - function.value(x - step, s)) / (2 * step)
    dsigma = (function.value(x, s + step) - function.value(x, s - step)) / (2 * step)
    torch.testing.assert_close(function.gradient(x, s)[0], dx, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(function.gradient(x, s)[1], dsigma, rtol=1e-5, atol=1e-6)


def test_derivative_closed_forms_of_the_elastic_kernel():
    """dG/dx = -2 x^(2/s-1) G and dG/ds = G x^(2/s) ((2/s) ln x - 1)."""
    x, s = f64([0.3, 0.9, 1.4]), f64(0.7)
    elastic = KERNELS["elastic"]
    G = elastic.value(x, s)
    torch.testing.assert_close(elastic.gradient(x, s)[0], -2 * x ** (2 / s - 1) * G)
    torch.testing.assert_close(elastic.gradient(x, s)[1], G * x ** (2 / s) * (2 / s * x.log() - 1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_everything_is_finite_at_any_distance_and_softness(kernel, dtype):
    """Also where x^(2/sigma) overflows, at x = 0 and 1, slightly negative x, and denormal or huge sigma."""
    x = torch.tensor([-1e-7, 0, 1e-30, 1e-6, 0.5, 1 - 1e-7, 1, 1 + 1e-6, 2, 1e3, 1e30, math.inf], dtype=dtype)
    sigma = torch.tensor([1e-40, 1e-6, 1e-3, 1 / 64, 0.5, 1, 4, 100, 1e20], dtype=dtype)[:, None]
    function = KERNELS[kernel]
    for result in (function.value(x, sigma), *function.gradient(x, sigma)):
        assert result.isfinite().all()


def test_slopes_stop_growing_at_their_floors():
    """At x = 0 (elastic, bilateral with sigma > 2) and at x = 1 (single-sided with sigma < 1)."""
    sigma = f64(4.0)
    for kernel in ("elastic", "bilateral"):
        floored, at_floor = (KERNELS[kernel].gradient(f64(x), sigma)[0] for x in (0.0, X_FLOOR))
        assert float(floored) == float(at_floor) != 0.0
    slope = KERNELS["single_sided"].gradient(f64([1 - 1e-9, 1 - RIM_FLOOR, 1.0, 1.1]), f64(0.3))[0]
    assert slope.tolist() == pytest.approx([-0.3 * RIM_FLOOR**-0.7, -0.3 * RIM_FLOOR**-0.7, 0.0, 0.0])


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("opacity", [0.01, 0.28, 0.95, 1.0])
def test_support_is_where_alpha_falls_to_the_threshold(kernel, sigma, opacity):
    function = KERNELS[kernel]
    end = function.support(f64(opacity), f64(sigma))
    if kernel == "hard":
        assert float(end) == 1.0
        return
    assert float(opacity * function.value(end * 0.999, f64(sigma))) > 1 / 255
    assert float(opacity * function.value(end * 1.001, f64(sigma))) < 1 / 255
    if float(1 - end) > 1e-9 or kernel != "single_sided":  # nearer to 1, x cannot tell the end from the edge
        assert float(opacity * function.value(end, f64(sigma))) == pytest.approx(1 / 255, rel=1e-6)


def test_support_of_a_triangle_too_faint_to_see_is_zero():
    for kernel in SMOOTH:
        assert float(KERNELS[kernel].support(f64(0.0039), f64(1.0))) == 0.0


def test_support_without_threshold_is_the_kernels_own_end():
    ends = [float(k.support(f64(0.5), f64(0.7), alpha_min=0.0)) for k in KERNELS.values()]
    assert ends == [1.0, math.inf, math.inf, 1.0]


@pytest.mark.parametrize("sigma", SIGMAS)
def test_area_is_the_integral_over_the_plane(kernel, sigma):
    """Level sets are scaled copies of the triangle, so the integral of 2 x G(x) is the effective area."""
    fine, far = torch.arange(20_001).double() / 20_000, torch.arange(400_001).double() / 1_000
    x = torch.cat([fine, 1 + 1e-12 + far])
    integral = torch.trapezoid(2 * x * KERNELS[kernel].value(x, f64(sigma)), x)
    assert float(KERNELS[kernel].area(f64(sigma))) == pytest.approx(float(integral), rel=1e-4)


def test_elastic_area_stays_near_that_of_the_triangle():
    area = KERNELS["elastic"].area(torch.linspace(1e-3, 1, 500, dtype=torch.float64))
    assert float(area.min()) >= 1.0 - 1e-12
    assert float(area.max()) < 1.29


def test_elastic_and_bilateral_coincide_at_one_half():
    x = torch.linspace(0, 2, 100, dtype=torch.float64)
    torch.testing.assert_close(KERNELS["elastic"].value(x, f64(0.5)), KERNELS["bilateral"].value(x, f64(0.5)))
    torch.testing.assert_close(
        KERNELS["elastic"].gradient(x, f64(0.5))[0], KERNELS["bilateral"].gradient(x, f64(0.5))[0]
    )


def test_boundary_values():
    sigma = f64(SIGMAS)
    one = torch.ones_like(sigma)
    torch.testing.assert_close(KERNELS["elastic"].value(one, sigma), torch.exp(-sigma))
    torch.testing.assert_close(KERNELS["bilateral"].value(one, sigma), one * math.exp(-0.5))
    assert (KERNELS["single_sided"].value(one, sigma) == 0).all()


def test_the_cut_at_two_discards_at_most_231_ten_thousandths_of_elastic_weight():
    sigma = torch.linspace(1e-3, 20, 20_000, dtype=torch.float64)
    value = KERNELS["elastic"].value(f64(2.0), sigma)
    assert float(value.max()) <= 0.0231
    assert float(sigma[value.argmax()]) == pytest.approx(2 * math.log(2), abs=2e-3)


def test_sharp_elastic_kernel_tends_to_the_step():
    x = f64([0.0, 0.5, 0.9, 1.1, 1.5])
    torch.testing.assert_close(
        KERNELS["elastic"].value(x, f64(1e-3)), KERNELS["hard"].value(x, f64(1e-3)), rtol=0, atol=2e-3
    )
