"""The registry of splatting kernels G(x): closed forms, derivatives, extents (paper, section "Kernel Function").

Every formula here is the one that ``csrc/math/kernels.h`` evaluates. A kernel that was registered from Python
(``core/registered_kernels.py``) has a table beside it, which native engines read.

Three floors keep values and derivatives finite, alike in every engine:

* x is raised to ``X_FLOOR``: dG/dx of the smooth kernels is unbounded at 0 for sigma > 2, and round-off can make x
  negative.
* sigma is raised to ``SIGMA_FLOOR``, below which float32 cannot tell a kernel from a step.
* 1 - x is raised to ``RIM_FLOOR`` in the derivatives of the single-sided kernel, whose slope is unbounded at x = 1 for
  sigma < 1.

The floors are passed straight through: the derivative at a floored argument is the one at the floor, not zero.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.kernel_table import KernelTable

X_FLOOR = 1e-6
SIGMA_FLOOR = 1e-6
RIM_FLOOR = 1e-4
# exp(40) is far beyond any visible sigma x^(2/sigma), and its products still fit float32.
_LOG_POWER_CAP = 40.0

DISTANCES = ("barycentric", "sdf")


def kernel_name(name: str) -> str:
    """As kernels are called within: "single-sided" is "single_sided"."""
    return name.replace("-", "_") if isinstance(name, str) else name


_Function = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Kernel:
    """One kernel G(x) with softness sigma; all members take and return tensors that broadcast.

    Attributes:
        name: Key in ``KERNELS``.
        value: ``(x, sigma) -> G``, in [0, 1].
        gradient: ``(x, sigma) -> (dG/dx, dG/dsigma)``.
        log_support: ``(log_ratio, sigma) -> X``, the largest x with ``ln G(x) >= -log_ratio``, for ``log_ratio >= 0``.
        area: ``sigma -> integral of G over the plane / area of the triangle``. The level sets of x are scaled copies of
            the triangle, so this is the integral of ``2 x G(x)``.
        table: What native engines draw it from; None where they have its formula.
    """

    name: str
    value: _Function
    gradient: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    log_support: _Function
    area: Callable[[Tensor], Tensor]
    table: KernelTable | None = None

    @property
    def native_name(self) -> str:
        """The struct in ``csrc/math`` that evaluates it."""
        return "Tabulated" if self.table is not None else "".join(map(str.capitalize, self.name.split("_")))

    @cached_property
    def native_id(self) -> int:
        """Its position in ``ETSPLAT_KERNELS``."""
        return _native.kernel_names().index(self.native_name)

    def support(self, opacity: Tensor, sigma: Tensor, alpha_min: float = 1 / 255) -> Tensor:
        """Largest x at which ``opacity * G(x) >= alpha_min``, before the cut at ``Cutoffs.x_max``.

        Zero where even G = 1 is too faint; infinite where ``alpha_min`` is 0 and the kernel has no end.
        """
        if alpha_min > 0:
            log_ratio = torch.log(opacity / alpha_min).clamp(min=0.0)
        else:
            log_ratio = torch.full_like(opacity, math.inf)
        return self.log_support(log_ratio, sigma.clamp(min=SIGMA_FLOOR))


def _power(x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x^(2/sigma), (2/sigma) ln x and sigma, with both floors."""
    sigma = sigma.clamp(min=SIGMA_FLOOR)
    log_power = ((2.0 / sigma) * x.clamp(min=X_FLOOR).log()).clamp(max=_LOG_POWER_CAP)
    return log_power.exp(), log_power, sigma


# Elastic kernel (the paper's own): G = exp(-sigma x^(2/sigma)).


def _elastic(x: Tensor, sigma: Tensor) -> Tensor:
    power, _, sigma = _power(x, sigma)
    return torch.exp(-sigma * power)


def _elastic_gradient(x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    power, log_power, sigma = _power(x, sigma)
    value = torch.exp(-sigma * power)
    return -2.0 * power / x.clamp(min=X_FLOOR) * value, power * (log_power - 1.0) * value


def _elastic_support(log_ratio: Tensor, sigma: Tensor) -> Tensor:
    return (log_ratio / sigma) ** (sigma / 2)


def _elastic_area(sigma: Tensor) -> Tensor:
    return torch.exp(torch.lgamma(sigma + 1) - sigma * sigma.log())


# Bilateral kernel (2DTS): G = exp(-x^(2/sigma) / 2).


def _bilateral(x: Tensor, sigma: Tensor) -> Tensor:
    power, _, _ = _power(x, sigma)
    return torch.exp(-0.5 * power)


def _bilateral_gradient(x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    power, log_power, sigma = _power(x, sigma)
    value = torch.exp(-0.5 * power)
    return -power / (sigma * x.clamp(min=X_FLOOR)) * value, 0.5 * power * (log_power / sigma) * value


def _bilateral_support(log_ratio: Tensor, sigma: Tensor) -> Tensor:
    return (2.0 * log_ratio) ** (sigma / 2)


def _bilateral_area(sigma: Tensor) -> Tensor:
    return torch.exp(torch.lgamma(sigma + 1) + sigma * math.log(2.0))


# Single-sided kernel (Triangle Splatting): G = max(1 - x, 0)^sigma.


def _single_sided(x: Tensor, sigma: Tensor) -> Tensor:
    inside = (1.0 - x.clamp(min=X_FLOOR)).clamp(min=0.0)
    # 0^sigma is 0 for the floored, positive sigma.
    return inside ** sigma.clamp(min=SIGMA_FLOOR)


def _single_sided_gradient(x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    rim, floored = (1.0 - x.clamp(min=X_FLOOR)).clamp(min=RIM_FLOOR), sigma.clamp(min=SIGMA_FLOOR)
    return torch.where(x < 1.0, -floored * rim ** (floored - 1.0), 0.0), _single_sided(x, sigma) * rim.log()


def _single_sided_support(log_ratio: Tensor, sigma: Tensor) -> Tensor:
    return 1.0 - torch.exp(-log_ratio / sigma)


def _single_sided_area(sigma: Tensor) -> Tensor:
    return 2.0 / ((sigma + 1) * (sigma + 2))


# Hard kernel: the opaque triangle, a step at x = 1; sigma has no effect.


def _hard(x: Tensor, sigma: Tensor) -> Tensor:
    x, _ = torch.broadcast_tensors(x, sigma)
    return (x <= 1.0).to(x.dtype)


def _hard_gradient(x: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    x, _ = torch.broadcast_tensors(x, sigma)
    return torch.zeros_like(x), torch.zeros_like(x)


def _hard_support(log_ratio: Tensor, sigma: Tensor) -> Tensor:
    log_ratio, _ = torch.broadcast_tensors(log_ratio, sigma)
    return torch.ones_like(log_ratio)


KERNELS: dict[str, Kernel] = {
    kernel.name: kernel
    for kernel in (
        Kernel("single_sided", _single_sided, _single_sided_gradient, _single_sided_support, _single_sided_area),
        Kernel("bilateral", _bilateral, _bilateral_gradient, _bilateral_support, _bilateral_area),
        Kernel("elastic", _elastic, _elastic_gradient, _elastic_support, _elastic_area),
        Kernel("hard", _hard, _hard_gradient, _hard_support, torch.ones_like),
    )
}
