"""A kernel as a table: what native engines draw a kernel from that was registered from Python.

G is known at knots in x for rows uniform in log sigma. Between knots it is a cubic in x whose slopes are limited so
that it is monotone wherever the knots are (Fritsch and Carlson 1980); between rows it is linear in log sigma. Beyond
the first and the last row, that row counts, and there is no derivative by sigma.

The knots lie in three zones, [0, 1/2], [1/2, 1] and [1, x_max], in which they get denser towards 0, 1 and 1, octave by
octave. So a processor finds the cell of an x in the exponent and the leading bits of a float
(``csrc/math/kernel_table.h``). x = 1 is there twice, because a kernel may have a kink: with the slope to the left, and
with the one to the right.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

ROWS = 577


class Zone(NamedTuple):
    """Knots from ``pivot`` in the direction ``sign``: ``octaves``, each twice as wide, of ``per_octave`` cells."""

    pivot: float
    sign: float
    octaves: int
    per_octave: int


ZONES = (Zone(0.0, 1.0, 5, 4), Zone(1.0, -1.0, 17, 3), Zone(1.0, 1.0, 6, 12))
_CELLS = tuple(zone.octaves * zone.per_octave for zone in ZONES)
LEFT = _CELLS[0] + _CELLS[1] + 1
"""Knots up to the first of the two at x = 1."""
KNOTS = LEFT + _CELLS[2] + 1
_OCTAVE = 0.75  # where an octave begins, as the native split of a float has it


def knots(x_max: float) -> Tensor:
    """(KNOTS,) float64, ascending; 1 is there twice."""
    return _knots(float(x_max)).clone()


@cache
def _knots(x_max: float) -> Tensor:
    parts = []
    for zone, width in zip(ZONES, _widths(x_max), strict=True):
        first = _first(zone)
        steps = _OCTAVE * (1.0 + torch.arange(zone.per_octave, dtype=torch.float64) / zone.per_octave)
        u = torch.cat([*(steps * 2.0**octave for octave in range(-zone.octaves, 0)), steps[:1]])
        parts.append(zone.pivot + zone.sign * width * (u - first) / (_OCTAVE - first))
    return torch.cat([parts[0][:-1], parts[1].flip(0), parts[2]])


def _widths(x_max: float) -> tuple[float, float, float]:
    return 0.5, 0.5, x_max - 1.0


def _first(zone: Zone) -> float:
    return _OCTAVE * 2.0**-zone.octaves


class TablePoint(NamedTuple):
    """G and its derivatives, of one shape."""

    value: Tensor
    dx: Tensor
    dsigma: Tensor


@dataclass(frozen=True, eq=False)
class KernelTable:
    """G(x, sigma) at knots; two tables are equal if their content is.

    Attributes:
        sigma: Smallest and largest softness; the rows are uniform in its logarithm.
        x_max: Largest x.
        values: (ROWS, KNOTS) float32 in [0, 1].
        slopes: (ROWS, KNOTS) float32, dG/dx.
    """

    sigma: tuple[float, float]
    x_max: float
    values: Tensor
    slopes: Tensor
    _native: dict[torch.device, Tensor] = field(default_factory=dict, repr=False)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KernelTable) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def digest(self) -> str:
        """SHA-256 of the content."""
        content = hashlib.sha256(repr((self.sigma, self.x_max)).encode())
        for tensor in (self.values, self.slopes):
            content.update(tensor.numpy().tobytes())
        return content.hexdigest()

    def to_tensors(self) -> dict[str, Tensor]:
        """What a file has to hold: "kernel.range" (sigma_min, sigma_max, x_max), "kernel.values", "kernel.slopes"."""
        limits = torch.tensor([*self.sigma, self.x_max], dtype=torch.float64)
        return {"kernel.range": limits, "kernel.values": self.values, "kernel.slopes": self.slopes}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "KernelTable":
        """The table that ``to_tensors`` took apart.

        Raises:
            ValueError: A tensor is missing, or is not what a table has.
        """
        names = ("kernel.range", "kernel.values", "kernel.slopes")
        shapes = ((3,), (ROWS, KNOTS), (ROWS, KNOTS))
        for name, shape in zip(names, shapes, strict=True):
            if name not in tensors or tuple(tensors[name].shape) != shape:
                raise ValueError(f"{name} of a kernel's table must have shape {shape}")
        limits, values, slopes = (tensors[name] for name in names)
        low, high, x_max = limits.double().tolist()
        sound = 0.0 < low < high < math.inf and 1.0 < x_max < math.inf and bool(slopes.isfinite().all())
        if not (sound and bool(((values >= 0.0) & (values <= 1.0)).all())):
            raise ValueError("a kernel's table must be finite, with values from 0 to 1 and 0 < sigma_min < sigma_max")
        return cls((low, high), x_max, values.float().contiguous(), slopes.float().contiguous())

    def evaluate(self, x: Tensor, sigma: Tensor) -> TablePoint:
        """The interpolant and its derivatives at any x and sigma, which broadcast, in float64."""
        x, sigma = torch.broadcast_tensors(x.double(), sigma.double())
        row, weight, per_sigma = self._row(sigma)
        places = _knots(self.x_max).to(x.device)
        x = x.clamp(0.0, self.x_max)
        cell = (torch.searchsorted(places, x, right=True) - 1).clamp(max=KNOTS - 2)
        width = places[cell + 1] - places[cell]
        t = (x - places[cell]) / width
        end = t.square() * (3.0 - 2.0 * t)
        basis = (1.0 - end, end, width * t * (1.0 - t).square(), width * t.square() * (t - 1.0))
        steep = 6.0 * t * (1.0 - t) / width
        basis_dx = (-steep, steep, (1.0 - t) * (1.0 - 3.0 * t), t * (3.0 * t - 2.0))
        low, high = self._at(row, cell), self._at(row + 1, cell)
        blended = [a + weight * (b - a) for a, b in zip(low, high, strict=True)]
        value = sum(b * v for b, v in zip(basis, blended, strict=True))
        dx = sum(b * v for b, v in zip(basis_dx, blended, strict=True))
        across = sum(b * (v1 - v0) for b, v0, v1 in zip(basis, low, high, strict=True))
        assert isinstance(value, Tensor)
        assert isinstance(dx, Tensor)
        return TablePoint(value, dx, across * per_sigma)

    def _row(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The row below, the weight of the one above, and the rows per unit of sigma, 0 outside of the range."""
        low, high = self.sigma
        per_log = (ROWS - 1) / math.log(high / low)
        place = (sigma / low).log() * per_log
        inside = (place >= 0.0) & (place <= ROWS - 1)
        place = place.clamp(0.0, ROWS - 1)
        row = place.floor().clamp(max=ROWS - 2)
        return row.long(), place - row, torch.where(inside, per_log / sigma, 0.0)

    def _at(self, row: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Values at both ends of a cell, then slopes."""
        values, slopes = self.values.to(row.device).double(), self.slopes.to(row.device).double()
        return values[row, cell], values[row, cell + 1], slopes[row, cell], slopes[row, cell + 1]

    def extent(self, threshold: Tensor, sigma: Tensor) -> Tensor:
        """Where a triangle ends: a cell past the last knot at which either row reaches ``threshold``.

        0 where no knot does, x_max for a sigma out of the range. Broadcasts; in float64.
        """
        threshold, sigma = torch.broadcast_tensors(threshold.double(), sigma.double())
        row, _, per_sigma = self._row(sigma)
        reached = self._reach.to(row.device)[row] >= threshold[..., None]
        last = reached.sum(dim=-1) - 1  # the running maximum never rises
        places = _knots(self.x_max).to(row.device)
        found = torch.where(last < 0, 0.0, places[(last + 1).clamp(max=KNOTS - 1)])
        return torch.where(per_sigma > 0, found, self.x_max)

    @property
    def _reach(self) -> Tensor:
        """(ROWS - 1, KNOTS) float32: the largest value of a row and the next, at a knot or to its right."""
        both = torch.maximum(self.values[:-1], self.values[1:])
        return both.flip(-1).cummax(dim=-1).values.flip(-1)

    def native(self, device: torch.device) -> Tensor:
        """The table as ``csrc/math/kernel_table.h`` reads it, one float32 tensor; the same one at every call."""
        if device not in self._native:
            self._native[device] = self._flattened().to(device)
        return self._native[device]

    def _flattened(self) -> Tensor:
        low, high = self.sigma
        per_octave = (ROWS - 1) / math.log2(high / low)
        header = [math.log2(low), per_octave, ROWS, KNOTS, 2 * (KNOTS + 1)]
        rows, start = [], 0
        parts = (slice(0, _CELLS[0] + 1), slice(_CELLS[0], LEFT), slice(LEFT, KNOTS))
        for zone, width, cells, part in zip(ZONES, _widths(self.x_max), _CELLS, parts, strict=True):
            first = _first(zone)
            scale = zone.sign * (_OCTAVE - first) / width  # du/dx
            header += [zone.pivot, scale, first, start + cells, zone.per_octave, _OCTAVE / zone.per_octave]
            pairs = torch.stack([self.values[:, part].double(), self.slopes[:, part].double() / scale], dim=-1)
            rows.append(pairs.flip(1) if zone.sign < 0 else pairs)
            start += cells + 1
        table = torch.cat(rows, dim=1)  # (ROWS, places, 2), from the pivot on
        content = (torch.tensor(header), _knots(self.x_max), self._reach, table)
        return torch.cat([part.reshape(-1).float() for part in content])


def limited_slopes(values: Tensor, slopes: Tensor, places: Tensor) -> Tensor:
    """Slopes (R, K) cut down so that the cubics through (R, K) values are monotone wherever the values are.

    At most three times the flatter of the neighbouring secants, and 0 at a turn (Fritsch and Carlson 1980).
    """
    secants = values.diff(dim=1) / places.diff()
    before = torch.cat([secants[:, :1], secants], dim=1)
    after = torch.cat([secants, secants[:, -1:]], dim=1)
    most = 3.0 * torch.minimum(before.abs(), after.abs())
    sign = before.sign()
    along = (slopes * sign).clamp(min=0.0).minimum(most) * sign
    return torch.where(before * after > 0.0, along, 0.0)
