"""Kernels from Python: what is refused, what the table is, and how near it comes to the function."""

import math

import pytest
import torch

import etsplat
from etsplat.core import kernels
from etsplat.core.kernel_table import KNOTS, LEFT, ROWS, KernelTable, knots, limited_slopes
from etsplat.core.kernels import KERNELS
from etsplat.core.registered_kernels import LARGEST_ERROR, adopt_table

SMOOTH = ("single_sided", "bilateral", "elastic")


@pytest.fixture(autouse=True)
def _registry(monkeypatch):
    """What a test registers is forgotten after it."""
    before = dict(kernels.KERNELS)
    yield
    kernels.KERNELS.clear()
    kernels.KERNELS.update(before)


def registered(value, **options) -> KernelTable:
    etsplat.register_kernel("mine", value, **options)
    table = KERNELS["mine"].table
    assert table is not None
    return table


def logistic(x, sigma):
    """Falls from 1 to 0 around x = 1, over a width in proportion to sigma."""
    return torch.sigmoid((1 - x) / (0.2 * sigma))


def samples(count=20_000, low=0.02, high=2.0):
    rng = torch.Generator().manual_seed(3)
    x = 2 * torch.rand(count, generator=rng, dtype=torch.float64)
    sigma = low * (high / low) ** torch.rand(count, generator=rng, dtype=torch.float64)
    return x, sigma


@pytest.mark.parametrize("name", SMOOTH)
def test_the_smooth_kernels_can_be_registered_again(name):
    """Between the knots the table is within its bound of the closed form, mostly far nearer."""
    error = etsplat.register_kernel("mine", KERNELS[name].value)
    assert error.elsewhere < LARGEST_ERROR
    x, sigma = samples()
    table = KERNELS["mine"].table
    assert table is not None
    difference = (table.evaluate(x, sigma).value - KERNELS[name].value(x, sigma)).abs()
    assert float(difference.quantile(0.999)) < 1e-3
    assert float(difference.max()) < LARGEST_ERROR


def test_what_is_left_out_of_the_bound_is_reported():
    """The single-sided kernel is a step of height 0.8 within 1e-6 of x = 1 where it is sharp; elastic, a cusp at 0."""
    error = etsplat.register_kernel("rim", KERNELS["single_sided"].value)
    assert error.edge > 0.1 > LARGEST_ERROR > error.centre
    error = etsplat.register_kernel("cusp", KERNELS["elastic"].value)
    assert error.centre > 0.01 > LARGEST_ERROR > error.edge
    assert error.edge_width < 0.003


@pytest.mark.parametrize("name", [*SMOOTH, "mine"])
def test_derivatives_are_those_of_the_interpolant(name):
    """Central differences of the interpolant itself, away from its knots and rows."""
    value = logistic if name == "mine" else KERNELS[name].value
    table = registered(value)
    places, log_sigma = knots(2.0), torch.linspace(math.log(0.01), math.log(4.0), ROWS, dtype=torch.float64)
    cells = (places[:-1] + 0.3 * places.diff())[places.diff() > 1e-4]
    rows = (log_sigma[:-1] + 0.4 * log_sigma.diff()).exp()[:, None]
    at, step = table.evaluate(cells, rows), 1e-6
    dx = (table.evaluate(cells + step, rows).value - table.evaluate(cells - step, rows).value) / (2 * step)
    torch.testing.assert_close(at.dx, dx, rtol=1e-5, atol=1e-6)
    grow = 1 + 1e-6
    dsigma = (table.evaluate(cells, rows * grow).value - table.evaluate(cells, rows / grow).value) / (
        rows * (grow - 1 / grow)
    )
    torch.testing.assert_close(at.dsigma, dsigma, rtol=1e-5, atol=1e-6)


def test_between_monotone_knots_it_is_monotone():
    """Also where the kernel falls within a cell; random steps of values, random slopes."""
    rng = torch.Generator().manual_seed(0)
    places = knots(2.0)[:LEFT]
    values = torch.rand(4, LEFT, generator=rng, dtype=torch.float64).sort(dim=1, descending=True).values
    slopes = limited_slopes(values, -100 * torch.rand(4, LEFT, generator=rng, dtype=torch.float64), places)
    every = torch.zeros(ROWS, KNOTS)
    full, tangents = every.clone(), every.clone()
    full[:4, :LEFT], tangents[:4, :LEFT] = values.float(), slopes.float()
    table = KernelTable((1.0, 2.0), 2.0, full, tangents)
    fine = torch.cat([places[:-1] + part * places.diff() for part in torch.linspace(0, 1, 21)]).sort().values
    for row in range(4):
        sigma = torch.tensor(2.0 ** (row / (ROWS - 1)), dtype=torch.float64)
        assert float(table.evaluate(fine[fine < 1], sigma).value.diff().max()) < 1e-6


def test_a_kink_at_the_edge_has_both_of_its_slopes():
    """G = 1 - x/2 up to x = 1, and half of that slope after it: straight lines are drawn as such."""
    table = registered(lambda x, sigma: torch.where(x < 1, 1 - x / 2, 0.75 - x / 4))
    x = torch.tensor([0.3, 0.999, 1.0, 1.001, 1.7], dtype=torch.float64)
    at = table.evaluate(x, torch.tensor(0.5))
    torch.testing.assert_close(at.value, torch.where(x < 1, 1 - x / 2, 0.75 - x / 4), rtol=0, atol=1e-6)
    assert at.dx.tolist() == pytest.approx([-0.5, -0.5, -0.25, -0.25, -0.25], abs=1e-3)
    assert (at.dsigma == 0).all()


def test_a_sigma_out_of_the_range_takes_the_end_row():
    table = registered(logistic, sigma=(0.1, 1.0))
    x = torch.linspace(0, 2, 50, dtype=torch.float64)
    for outside, end in ((0.01, 0.1), (50.0, 1.0)):
        at, nearest = (table.evaluate(x, torch.tensor(s, dtype=torch.float64)) for s in (outside, end))
        torch.testing.assert_close(at.value, nearest.value, rtol=0, atol=1e-12)
        torch.testing.assert_close(at.dx, nearest.dx, rtol=1e-9, atol=1e-9)
        assert (at.dsigma == 0).all()


@pytest.mark.parametrize("name", [*SMOOTH, "waves"])
def test_nothing_is_visible_beyond_the_extent(name):
    """Also of a kernel that rises again; and either row reaches the threshold at the knot before."""
    value = waves if name == "waves" else KERNELS[name].value
    table = registered(value)
    x, sigma = torch.linspace(0, 2, 4001, dtype=torch.float64), samples(200, 0.01, 4.0)[1][:, None]
    for threshold in (0.9, 0.2, 1 / 255):
        extent = table.extent(torch.tensor(threshold), sigma)
        visible = table.evaluate(x, sigma).value >= threshold
        assert not (visible & (x > extent)).any()
        before = torch.searchsorted(knots(2.0), extent) - 1
        row = ((sigma / 0.01).log() / math.log(400) * (ROWS - 1)).long()
        assert (torch.maximum(table.values[row, before], table.values[row + 1, before]) >= threshold).all()


def waves(x, sigma):
    """Rings that get fainter outwards."""
    return torch.exp(-2 * x) * (0.6 + 0.4 * torch.cos(5 * x * (1 + 0.1 * sigma)))


def test_reference_calls_the_function_itself(rng):
    """Value and derivatives are the function's, to rounding, not the table's; the floors hold."""
    registered(logistic)
    kernel, sigma = KERNELS["mine"], torch.tensor(0.05, dtype=torch.float64)
    x = torch.linspace(0, 2, 777, dtype=torch.float64)
    torch.testing.assert_close(kernel.value(x, sigma), logistic(x.clamp(min=1e-6), sigma), rtol=0, atol=0)
    value = logistic(x, sigma)
    slope = -value * (1 - value) / (0.2 * sigma)
    away = (x - 1).abs() > 2e-4
    torch.testing.assert_close(kernel.gradient(x, sigma)[0][away], slope[away], rtol=1e-4, atol=1e-9)
    across = -slope * (1 - x) / sigma * -1
    torch.testing.assert_close(kernel.gradient(x, sigma)[1][away], across[away], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", SMOOTH)
def test_derivatives_by_autograd_are_the_closed_forms(name):
    """Of the built-in functions registered again, with the same floors."""
    registered(KERNELS[name].value)
    mine, built_in = KERNELS["mine"], KERNELS[name]
    x, sigma = samples()
    x = torch.cat([x, torch.tensor([0.0, 1e-9, 1.0, 1 - 1e-7])]).double()
    sigma = torch.cat([sigma, torch.tensor([0.3, 3.0, 0.5, 0.5])]).double()
    torch.testing.assert_close(mine.value(x, sigma), built_in.value(x, sigma), rtol=0, atol=0)
    torch.testing.assert_close(mine.gradient(x, sigma)[0], built_in.gradient(x, sigma)[0], rtol=5e-3, atol=1e-9)
    at_rim = (x - 1).abs() < 1e-4
    torch.testing.assert_close(
        mine.gradient(x, sigma)[1][~at_rim], built_in.gradient(x, sigma)[1][~at_rim], rtol=1e-6, atol=1e-9
    )
    sharp = torch.tensor([0.05, 0.2, 0.5], dtype=torch.float64)
    torch.testing.assert_close(mine.area(sharp), built_in.area(sharp), rtol=1e-3, atol=0)


class TestRefused:
    """Each with the x and sigma of the first place."""

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            (lambda x, s: 1.5 * torch.exp(-x), r"value must be in \[0, 1\], got 1\.49.* at x=0\.0, sigma=0\.01"),
            (lambda x, s: x.log(), r"value must be in \[0, 1\], got -13\.8.* at x=0\.0, sigma=0\.01"),
            (lambda x, s: torch.where(x > 1.5, torch.nan, 0 * x), r"got nan at x=1\.5"),
            (lambda x, s: torch.where(x < 1, (1 - x) ** s, 0), r"derivative by x must be finite, got nan at x=1\.0"),
            (
                lambda x, s: torch.sigmoid((0.7 - x) / 1e-3),
                r"is off by 0\.\d+ near x=0\.\d+, sigma=.* changes too steeply",
            ),
            (lambda x, s: 0.5, "value must return torch.float64 .* like x, got float"),
            (lambda x, s: 1.0 if x < 1 else 0.5, "value ended with RuntimeError: .*; x and sigma are tensors .*where"),
            (lambda x, s: math.exp(-x), "value ended with .*, of which it is to return another, by functions of torch"),
            (lambda x, s: torch.exp(-x.float()), "got torch.float32"),
            (lambda x, s: torch.exp(-x).mean(), r"got torch.float64 \(\)"),
        ],
    )
    def test_values(self, value, message):
        with pytest.raises(ValueError, match=message):
            etsplat.register_kernel("mine", value)
        assert "mine" not in KERNELS

    @pytest.mark.parametrize("steepness", [0.0, 1e-7])
    def test_steps(self, steepness):
        """The kernel "hard", what is as good as one, and one that is a step for some sigma only."""
        value = KERNELS["hard"].value if steepness == 0.0 else lambda x, s: torch.sigmoid((1 - x) / steepness)
        with pytest.raises(ValueError, match="step at x = 1"):
            etsplat.register_kernel("mine", value)
        elastic = KERNELS["elastic"].value
        with pytest.raises(ValueError, match=r"step at x = 1|too steeply"):
            etsplat.register_kernel("mine", lambda x, s: torch.where(s < 0.5, value(x, s), elastic(x, s)))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"name": "elastic"}, "no built-in kernel"),
            ({"name": "not a name"}, "identifier"),
            ({"sigma": (0.5, 0.5)}, "sigma must be a range"),
            ({"sigma": (0.0, 0.5)}, "sigma must be a range"),
            ({"x_max": 1.0}, "x_max must be more than 1"),
            ({"x_max": math.inf}, "x_max must be more than 1"),
        ],
    )
    def test_options(self, options, message):
        with pytest.raises(ValueError, match=message):
            etsplat.register_kernel(**{"name": "mine", "value": logistic, **options})

    def test_another_function_under_a_name_that_is_taken(self):
        """A name means one kernel; the same function again is no other."""
        etsplat.register_kernel("mine", logistic)
        etsplat.register_kernel("mine", lambda x, s: torch.sigmoid((1 - x) / (0.2 * s)))
        with pytest.raises(ValueError, match="another kernel is registered as 'mine'"):
            etsplat.register_kernel("mine", waves)

    def test_a_cell_that_is_run_again_replaces_its_kernel(self):
        """On engine cpu, which has the table, and in a model that names it."""
        etsplat.register_kernel("mine", logistic)
        mesh = etsplat.TriangleMesh.from_mesh(
            *etsplat.icosphere(0), colors=0.5, opacity=0.9, sigma=0.5, appearance=etsplat.MeshAppearance("mine")
        )
        camera = etsplat.orbit_cameras(16, 16, elevations=(0.0,), azimuths=1)
        before = mesh.render(camera).color
        etsplat.register_kernel("mine", waves, replace=True)
        again = mesh.render(camera).color
        etsplat.register_kernel("other", waves)
        mesh.appearance = etsplat.MeshAppearance("other")
        assert torch.equal(again, mesh.render(camera).color)
        assert not torch.equal(again, before)


class TestFiles:
    """A table comes back from what a file holds, and is drawn without the function."""

    def test_round_trip(self):
        table = registered(logistic, sigma=(0.05, 2.0), x_max=1.5)
        again = KernelTable.from_tensors({name: tensor.clone() for name, tensor in table.to_tensors().items()})
        assert again == table
        assert hash(again) == hash(table)
        assert again != registered_as("other", waves)

    def test_adopted(self):
        """The interpolant is the function then."""
        table = registered(logistic)
        adopt_table("mine", table)  # known already
        del KERNELS["mine"]
        adopt_table("mine", KernelTable.from_tensors(table.to_tensors()))
        x, sigma = samples(500)
        kernel = KERNELS["mine"]
        torch.testing.assert_close(kernel.value(x, sigma), table.evaluate(x, sigma).value, rtol=0, atol=0)
        assert kernel.value(x.float(), sigma.float()).dtype == torch.float32
        torch.testing.assert_close(kernel.value(x, sigma), logistic(x, sigma), rtol=0, atol=LARGEST_ERROR)
        for derivative in kernel.gradient(x, sigma):
            assert derivative.isfinite().all()
        with pytest.raises(ValueError, match="another kernel is registered"):
            adopt_table("mine", registered_as("other", waves))

    @pytest.mark.parametrize("name", ["elastic", "../mine"])
    def test_names_that_no_kernel_has(self, name):
        with pytest.raises(ValueError, match="no registered kernel can have"):
            adopt_table(name, registered(logistic))

    def test_damage(self):
        tensors = registered(logistic).to_tensors()
        with pytest.raises(ValueError, match=r"kernel\.slopes .* must have shape"):
            KernelTable.from_tensors({**tensors, "kernel.slopes": tensors["kernel.slopes"][:5]})
        with pytest.raises(ValueError, match="must be finite"):
            KernelTable.from_tensors({**tensors, "kernel.values": tensors["kernel.values"] + 1})


def registered_as(name, value) -> KernelTable:
    etsplat.register_kernel(name, value)
    table = KERNELS[name].table
    assert table is not None
    return table
