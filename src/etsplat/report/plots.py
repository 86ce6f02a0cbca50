"""A picture of how a run went: convergence.png."""

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import Formatter, NullLocator

from etsplat.io.atomic import atomic_write
from etsplat.report.curves import curves_of, log_ticks, short_number, tick_labels
from etsplat.report.data import Run


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
