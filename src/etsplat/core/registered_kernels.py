"""Kernels from Python: ``register_kernel`` makes a table of a function, for the native engines, and checks both."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from etsplat.core.kernel_table import KNOTS, LEFT, ROWS, KernelTable, knots, limited_slopes
from etsplat.core.kernels import KERNELS, RIM_FLOOR, SIGMA_FLOOR, X_FLOOR, Kernel
from etsplat.core.validation import check_kind, shown

LARGEST_ERROR = 5e-3
"""Of a table, in units of G: about one level of an 8-bit image."""
_BESIDE = 1e-9  # from x = 1, where the slopes of a kink are taken
_STEPS = (2.0**-25, 2.0**-50)  # from x = 1, where a step is as high at both

KernelFunction = Callable[[Tensor, Tensor], Tensor]
_BUILT_IN = frozenset(KERNELS)


class TableError(NamedTuple):
    """How far a table is from the function that it was made of, in units of G, midway between knots and rows.

    Attributes:
        elsewhere: The largest difference in all cells but the following; at most ``LARGEST_ERROR``.
        centre: ... in the cell at x = 0, where the slope of a kernel may be unbounded.
        edge: ... in the cells on both sides of x = 1, where it may have a kink.
        edge_width: Of those cells, in x.
    """

    elsewhere: float
    centre: float
    edge: float
    edge_width: float


def register_kernel(
    name: str,
    value: KernelFunction,
    sigma: tuple[float, float] = (0.01, 4.0),
    x_max: float = 2.0,
    *,
    replace: bool = False,
) -> TableError:
    """Make ``rasterize(kernel=name)`` draw with a kernel G(x) of one's own, in every engine and without a compiler.

    The reference engine calls ``value`` itself and differentiates it by autograd. The native engines read a table
    of it, a monotone cubic in x and linear in log sigma, with the derivatives of that interpolant; docs/method.md has
    the formulas. A sigma out of the range is drawn by them like the nearest end of it. The same floors hold as for the
    built-in kernels: x and sigma are raised to 1e-6, and derivatives are taken at least 1e-4 away from x = 1.

    Args:
        name: A new name, an identifier; registering the same function again changes nothing.
        value: (x, sigma) -> G(x), elementwise in torch: float64 tensors of one shape in, the same shape out. x is 0 at
            the centre of the triangle and 1 on its edge, sigma the softness. Differentiable by autograd.
        sigma: Smallest and largest softness of the table.
        x_max: Largest x that a call may draw, ``Cutoffs.x_max``; > 1.
        replace: Whether it takes the place of another kernel of that name, as where a notebook's cell is run again.
            Models that have it are drawn by the new one from then on.

    Returns:
        How far the table is from the function.

    Raises:
        ValueError: The name is taken, and ``replace`` is False; ``value`` is not in [0, 1], or it or a derivative is
            not finite (with the x and sigma of the first place); it has a step; or the table is off by more than 0.005
            between its knots.

    Example:
        >>> def smooth_step(x, sigma):
        ...     return torch.sigmoid((1 - x) / (0.25 * sigma))
        >>> error = etsplat.register_kernel("smooth_step", smooth_step)
        >>> error.elsewhere < 0.005  # a table that is farther off is refused
        True
    """
    check_kind("name", name, str)
    if not callable(value):
        raise ValueError(f"value must be a function of x and sigma, got {shown(value)}")
    if not name.isidentifier() or name in _BUILT_IN:
        raise ValueError(f"register_kernel: name must be a Python identifier and no built-in kernel, got {name!r}")
    low, high = sigma
    if not SIGMA_FLOOR <= low < high < math.inf:
        raise ValueError(f"register_kernel: sigma must be a range (low, high) with {SIGMA_FLOOR} <= low, got {sigma}")
    if not 1.0 < x_max < math.inf:
        raise ValueError(f"register_kernel: x_max must be more than 1 and finite, got {x_max}")
    function = _Function(name, value)
    table = _tabulate(function, (float(low), float(high)), float(x_max))
    error = _measure(function, table)
    kernel = Kernel(name, function.value, function.gradient, _support(table), _area(function.value, x_max), table)
    if not replace:
        _check_free(name, table, ", or pass replace=True")
    KERNELS[name] = kernel
    return error


def adopt_table(name: str, table: KernelTable) -> None:
    """Register what a file holds of a kernel: the interpolant is its function, in every engine.

    Raises:
        ValueError: Another kernel has this name.
    """
    if name in _BUILT_IN or not name.isidentifier():
        raise ValueError(f"a kernel's table has the name {name!r}, which no registered kernel can have")

    _check_free(name, table)
    if name in KERNELS:
        return

    def value(x: Tensor, sigma: Tensor) -> Tensor:
        return table.evaluate(x.clamp(min=X_FLOOR), sigma).value.to(x.dtype)

    def gradient(x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
        point = table.evaluate(_off_the_rim(x), sigma)
        return point.dx.to(x.dtype), point.dsigma.to(x.dtype)

    KERNELS[name] = Kernel(name, value, gradient, _support(table), _area(value, table.x_max), table)


def _check_free(name: str, table: KernelTable, otherwise: str = "") -> None:
    """A name means one kernel unless somebody replaces it: what was drawn with it is drawn alike later."""
    if name in KERNELS and KERNELS[name].table != table:
        raise ValueError(f"another kernel is registered as {name!r} in this process: choose another name{otherwise}")


class _Function:
    """A user's function in float64, checked, with the floors."""

    def __init__(self, name: str, function: KernelFunction) -> None:
        self.name = name
        self.function = function

    def value(self, x: Tensor, sigma: Tensor) -> Tensor:
        return self._call(x.clamp(min=X_FLOOR), sigma).to(x.dtype)

    def gradient(self, x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
        dx, dsigma = self._derivatives(_off_the_rim(x), sigma)
        return dx.to(x.dtype), dsigma.to(x.dtype)

    def slopes(self, x: Tensor, sigma: Tensor) -> Tensor:
        """dG/dx where a table wants it: beside x = 1, not as far as the floor."""
        dx, dsigma = self._derivatives(x.clamp(min=X_FLOOR), sigma)
        for what, derivative in (("x", dx), ("sigma", dsigma)):
            self._check(derivative.isfinite(), derivative, f"the derivative by {what}", "must be finite", x, sigma)
        return dx

    def checked(self, x: Tensor, sigma: Tensor) -> Tensor:
        result = self.value(x, sigma)
        self._check(
            result.isfinite() & (result >= 0.0) & (result <= 1.0), result, "value", "must be in [0, 1]", x, sigma
        )
        return result

    def _call(self, x: Tensor, sigma: Tensor) -> Tensor:
        x, sigma = torch.broadcast_tensors(x.double(), sigma.double().clamp(min=SIGMA_FLOOR))
        try:
            result = self.function(x, sigma)
        except Exception as error:  # whatever a user's function raises that takes one number at a time
            raise ValueError(
                f"kernel {self.name!r}: value ended with {type(error).__name__}: {error}; x and sigma are tensors of"
                " one shape, of which it is to return another, by functions of torch: torch.where in the place of if"
            ) from error
        if not isinstance(result, Tensor) or result.shape != x.shape or result.dtype != x.dtype:
            got = f"{result.dtype} {tuple(result.shape)}" if isinstance(result, Tensor) else type(result).__name__
            raise ValueError(f"kernel {self.name!r}: value must return {x.dtype} {tuple(x.shape)} like x, got {got}")
        return result

    def _derivatives(self, x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
        x, sigma = torch.broadcast_tensors(x.detach().double(), sigma.detach().double())
        with torch.enable_grad():
            leaves = x.clone().requires_grad_(), sigma.clone().requires_grad_()
            result = self._call(*leaves)
            if not result.requires_grad:
                return torch.zeros_like(x), torch.zeros_like(x)
            dx, dsigma = torch.autograd.grad(result.sum(), leaves, allow_unused=True, materialize_grads=True)
        return dx, dsigma

    def _check(self, good: Tensor, result: Tensor, what: str, must: str, x: Tensor, sigma: Tensor) -> None:
        if bool(good.all()):
            return
        place = tuple((~good).nonzero()[0].tolist())
        x, sigma = torch.broadcast_tensors(x, sigma)
        raise ValueError(
            f"kernel {self.name!r}: {what} {must}, got {float(result[place])} at x={float(x[place])}, "
            f"sigma={float(sigma[place])}"
        )


def _off_the_rim(x: Tensor) -> Tensor:
    """The floor of x, and no nearer to 1 than ``RIM_FLOOR``, where slopes may be unbounded."""
    inside = x.clamp(X_FLOOR, 1.0 - RIM_FLOOR)
    return torch.where(x < 1.0, inside, x.clamp(min=1.0 + RIM_FLOOR))


def _tabulate(function: _Function, sigma: tuple[float, float], x_max: float) -> KernelTable:
    places, rows = knots(x_max), _rows(sigma)
    beside = places.clone()
    beside[LEFT - 1] -= _BESIDE
    beside[LEFT] += _BESIDE
    values, slopes = function.checked(places, rows), function.slopes(beside, rows)
    halves = (slice(0, LEFT), slice(LEFT, KNOTS))
    limited = [limited_slopes(values[:, half], slopes[:, half], places[half]) for half in halves]
    return KernelTable(sigma, x_max, values.float(), torch.cat(limited, dim=1).float())


def _rows(sigma: tuple[float, float]) -> Tensor:
    logs = torch.linspace(math.log(sigma[0]), math.log(sigma[1]), ROWS, dtype=torch.float64)
    return logs.exp().clamp(*sigma)[:, None]


def _measure(function: _Function, table: KernelTable) -> TableError:
    """At three places in each cell, on every row and midway between two."""
    places, rows = knots(table.x_max), _rows(table.sigma)
    rows = torch.cat([rows, (rows[1:] * rows[:-1]).sqrt()])
    error = torch.zeros(len(rows), KNOTS - 1, dtype=torch.float64)
    for part in (0.25, 0.5, 0.75):
        x = places[:-1] + part * places.diff()
        difference = (table.evaluate(x, rows).value - function.checked(x, rows)).abs()
        error = torch.maximum(error, difference)
    edge = [LEFT - 2, LEFT]
    widths = places.diff()
    others = torch.ones(KNOTS - 1, dtype=torch.bool)
    others[[0, LEFT - 1, *edge]] = False
    result = TableError(
        float(error[:, others].max()), float(error[:, 0].max()), float(error[:, edge].max()), float(widths[edge].max())
    )
    at_edge = error[:, edge].amax(dim=1)
    if float(at_edge.min()) > LARGEST_ERROR or _has_step(function, rows):
        raise ValueError(
            f"kernel {function.name!r} has a step at x = 1, which has no gradient: let it fall over some x, for "
            "the softest sigma at least"
        )
    if result.elsewhere > LARGEST_ERROR:
        row, cell = divmod(int(torch.where(others, error, 0.0).argmax()), KNOTS - 1)
        raise ValueError(
            f"kernel {function.name!r}: the table that native engines draw from is off by {result.elsewhere:.2g} near "
            f"x={float(places[cell]):.4g}, sigma={float(rows[row]):.4g}, more than {LARGEST_ERROR}: it changes too "
            "steeply there; raise the lower end of sigma, or smooth it"
        )
    return result


def _has_step(function: _Function, rows: Tensor) -> bool:
    """A power of 1 - x, however small, falls from one of ``_STEPS`` to the next; a step does not."""
    for sign in (-1.0, 1.0):
        x = torch.tensor([1.0, *(1.0 + sign * step for step in _STEPS)], dtype=torch.float64)
        at, far, near = function.checked(x, rows).unbind(dim=1)
        height = (near - at).abs()
        if bool(((height > LARGEST_ERROR) & (height > 0.99 * (far - at).abs())).any()):
            return True
    return False


def _support(table: KernelTable) -> KernelFunction:
    def log_support(log_ratio: Tensor, sigma: Tensor) -> Tensor:
        return table.extent((-log_ratio).exp(), sigma).to(log_ratio.dtype)

    return log_support


def _area(value: KernelFunction, x_max: float) -> Callable[[Tensor], Tensor]:
    def area(sigma: Tensor) -> Tensor:
        x = torch.linspace(0.0, x_max, 20_001, dtype=sigma.dtype, device=sigma.device)
        return torch.trapezoid(2.0 * x * value(x, sigma[..., None]), x)

    return area
