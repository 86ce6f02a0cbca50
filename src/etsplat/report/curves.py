"""Convergence curves: which quantities are shown and how, thinned for display; drawn as inline SVG, and as one PNG."""

import math
import sys
from dataclasses import dataclass
from html import escape
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import Formatter, NullLocator

from etsplat.io.atomic import atomic_write
from etsplat.report.data import Run

MAX_POINTS = 400
"""Longer series are shown as this many bucket means with the range of each bucket behind."""

WIDTH, HEIGHT = 400, 200
LEFT, RIGHT, TOP, BOTTOM = 46, 12, 10, 24


@dataclass(frozen=True)
class Quantity:
    """A history key, its title, whether its axis is logarithmic, the metric that is its lower bound, and its scale.

    `band` names two further keys, whose range is shown around the line.
    """

    key: str
    title: str
    logarithmic: bool
    floor_key: str | None = None
    scale: float = 1.0
    band: tuple[str, str] | None = None


QUANTITIES = (
    Quantity("loss", "Training loss", True),
    Quantity("psnr", "PSNR of test views, dB", False),
    Quantity("watched_psnr", "PSNR of watched photos, dB", False),
    Quantity("chamfer", "Chamfer distance × 10⁻³", True, floor_key="chamfer_floor", scale=1000.0),
    Quantity("sigma", "Softness σ", True, band=("sigma_10", "sigma_90")),
    Quantity("opacity", "Opacity", False, band=("opacity_10", "opacity_90")),
    Quantity("faces", "Faces", False),
    Quantity("triangles", "Triangles", False),
)


@dataclass(frozen=True)
class Curve:
    """A thinned series, ready to draw: means, and the lowest and highest value in each bucket."""

    quantity: Quantity
    x: list[float]
    mean: list[float]
    low: list[float]
    high: list[float]
    floor: float | None

    @property
    def logarithmic(self) -> bool:
        """A logarithmic axis where asked for and possible."""
        return self.quantity.logarithmic and min(*self.low, *self.mean, *self.high) > 0


def curves_of(run: Run) -> list[Curve]:
    """The curves that the run's history has at least two points of."""
    curves = []
    for quantity in QUANTITIES:
        x, y = run.series(quantity.key)
        if len(x) >= 2:
            floor = run.metrics.get(quantity.floor_key) if quantity.floor_key else None
            x, mean, low, high = _thin(x, [quantity.scale * value for value in y])
            if quantity.band is not None:
                (_, lower), (_, upper) = (run.series(key) for key in quantity.band)
                if len(lower) == len(upper) == len(y):
                    low, high = _thin(lower, lower)[2], _thin(upper, upper)[3]
            curves.append(
                Curve(quantity, x, mean, low, high, floor=quantity.scale * floor if floor and floor > 0 else None)
            )
    return curves


def draw_svg(curve: Curve) -> str:
    """One chart as an SVG element, coloured by the page's style sheet."""
    values = curve.low + curve.high + ([curve.floor] if curve.floor else [])
    ticks = log_ticks(min(values), max(values)) if curve.logarithmic else linear_ticks(min(values), max(values))
    warp = math.log10 if curve.logarithmic else float
    bottom, top = warp(min(*values, *ticks)), warp(max(*values, *ticks))
    start, end = curve.x[0], curve.x[-1]

    def px(x: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (x - start) / (end - start)

    def py(y: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - (warp(y) - bottom) / ((top - bottom) or 1))

    parts = []
    for tick, text in zip(ticks, tick_labels(ticks), strict=True):
        y = py(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    for tick in linear_ticks(start, end, 4):
        if start <= tick <= end:
            parts.append(f'<text x="{px(tick):.1f}" y="{HEIGHT - 6}" text-anchor="middle">{short_number(tick)}</text>')
    if curve.floor:
        y = py(curve.floor)
        parts.append(f'<line class="floor" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(
            f'<text class="floor-name" x="{WIDTH - RIGHT}" y="{y - 5:.1f}" text-anchor="end">sampling floor</text>'
        )
    upper = [(px(x), py(y)) for x, y in zip(curve.x, curve.high, strict=True)]
    lower = [(px(x), py(y)) for x, y in zip(curve.x, curve.low, strict=True)]
    parts.append(f'<path class="band" d="{_path(upper + lower[::-1])}Z"/>')
    line = [(px(x), py(y)) for x, y in zip(curve.x, curve.mean, strict=True)]
    parts.append(f'<path class="line" d="{_path(line)}"/>')
    label = escape(f"{curve.quantity.title}: from {short_number(curve.mean[0])} to {short_number(curve.mean[-1])}")
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def linear_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round values, about `count`, that cover [low, high]."""
    span = (high - low) or abs(high) or 1.0
    raw = max(span / max(count - 1, 1), sys.float_info.min)
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * unit for factor in (1, 2, 2.5, 5, 10) if factor * unit >= raw * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 times powers of ten inside [low, high], thinned to at most six; its ends if there are fewer than two."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1, 2, 5), (1, 3), (1,)):
        ticks = [f * 10.0**d for d in decades for f in factors if low <= f * 10.0**d <= high]
        if len(ticks) <= 6:
            break
    return ticks if len(ticks) >= 2 else [low, high]


def tick_labels(ticks: list[float]) -> list[str]:
    """Short numbers, with as many digits as it takes to tell them from each other, up to six."""
    labels = []
    for digits in range(3, 7):
        labels = [short_number(tick, digits) for tick in ticks]
        if len(set(labels)) == len(labels):
            break
    return labels


def short_number(value: float, digits: int = 3) -> str:
    """At most so many significant digits (three at least), thousands as k, small ones as powers of ten."""
    if value == 0:
        return "0"
    if abs(value) >= 1e6:
        return f"{value / 1e6:.{digits}g}M"
    if abs(value) >= 1e4 or (abs(value) >= 1000 and value % 100 == 0):
        return f"{value / 1e3:.{digits}g}k"
    if abs(value) >= 100:
        return f"{value:.{digits - 3}f}"
    if abs(value) >= 1e-3:
        return f"{value:.{digits}g}"
    return f"{value:.{digits - 2}e}".replace(".0e", "e").replace("e-0", "e-")


def _thin(x: list[float], y: list[float]) -> tuple[list[float], list[float], list[float], list[float]]:
    size = max(1, math.ceil(len(x) / MAX_POINTS))
    buckets = [slice(start, start + size) for start in range(0, len(x), size)]
    return (
        [x[b][-1] for b in buckets],
        [sum(y[b]) / len(y[b]) for b in buckets],
        [min(y[b]) for b in buckets],
        [max(y[b]) for b in buckets],
    )


def _path(points: list[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


class ShortNumbers(Formatter):
    """Labels of an axis, as the report has them."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """One by itself."""
        return short_number(x)

    def format_ticks(self, values: list[float]) -> list[str]:
        """All of them."""
        return tick_labels(values)


def plot_convergence(run: Run, path: Path) -> None:
    """Draw the run's curves as one PNG."""
    curves = curves_of(run)
    columns = min(3, len(curves)) or 1
    rows = -(-len(curves) // columns) or 1
    figure = Figure(figsize=(4.2 * columns, 3.1 * rows), layout="constrained")
    for index, curve in enumerate(curves):
        axes = figure.add_subplot(rows, columns, index + 1)
        axes.fill_between(curve.x, curve.low, curve.high, color="#2060a8", alpha=0.18, linewidth=0)
        axes.plot(curve.x, curve.mean, color="#2060a8", linewidth=1.6)
        if curve.floor:
            axes.axhline(curve.floor, color="#a4502a", linestyle="--", linewidth=1.1, label="sampling floor")
            axes.legend(frameon=False, fontsize=8)
        axes.set_title(curve.quantity.title, fontsize=10, loc="left")
        axes.set_xlabel("iteration", fontsize=9)
        if curve.logarithmic:
            axes.set_yscale("log")
            axes.yaxis.set_minor_locator(NullLocator())
            axes.set_yticks(log_ticks(*axes.get_ylim()))
        axes.yaxis.set_major_formatter(ShortNumbers())
        axes.grid(color="#e4e6e8", linewidth=0.8)
        axes.tick_params(labelsize=8, colors="#5b6570")
        axes.spines[["top", "right"]].set_visible(False)
    if not curves:
        figure.text(0.5, 0.5, "no history", ha="center", va="center")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=130)
