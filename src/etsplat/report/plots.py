"""Pictures of a run: convergence.png and overview.png."""

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import Formatter, NullLocator
from PIL import Image, ImageDraw, ImageFont

from etsplat.io.atomic import atomic_write
from etsplat.report.curves import curves_of, log_ticks, short_number, tick_labels
from etsplat.report.data import Run, TestView

OVERVIEW_VIEWS = 4
TILE = 360
CAPTION = 34
GAP = 4


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


def draw_overview(run: Run, path: Path) -> None:
    """Draw the contact sheet: a column for each of up to four test views; rows truth, render, mesh or opaque."""
    views = spread(run.views, OVERVIEW_VIEWS)
    if not views:
        return
    rows = {"truth": "truth", "render": "render", "opaque": "opaque" if run.mesh is None else "mesh"}
    tiles = {kind: [_tile(getattr(view, kind)) for view in views] for kind in rows}
    wide = max(tile.width for row in tiles.values() for tile in row)
    high = max(tile.height for row in tiles.values() for tile in row)
    size = CAPTION + len(views) * (wide + GAP), len(rows) * (high + GAP) + GAP
    sheet = Image.new("RGB", size, "#14171a")
    font = ImageFont.load_default(size=17)
    for row, (kind, title) in enumerate(rows.items()):
        top = GAP + row * (high + GAP)
        label = Image.new("RGB", (high, CAPTION), "#14171a")
        ImageDraw.Draw(label).text((high / 2, CAPTION / 2), title, fill="#c6ccd2", font=font, anchor="mm")
        sheet.paste(label.transpose(Image.Transpose.ROTATE_90), (0, top))
        for column, tile in enumerate(tiles[kind]):
            left = CAPTION + column * (wide + GAP)
            sheet.paste(tile, (left + (wide - tile.width) // 2, top + (high - tile.height) // 2))
    with atomic_write(path) as temporary:
        sheet.save(temporary)


def spread(views: list[TestView], count: int) -> list[TestView]:
    """At most `count` of the views, evenly spaced, the first one among them."""
    step = max(1.0, len(views) / count)
    return [views[int(index * step)] for index in range(min(count, len(views)))]


def _tile(path: Path) -> Image.Image:
    with Image.open(path) as image:
        image = image.convert("RGB")
    scale = TILE / max(image.size)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.LANCZOS if scale < 1 else Image.Resampling.NEAREST)
