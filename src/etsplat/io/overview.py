"""The pictures of a run's test views, and a contact sheet of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from etsplat.io.images import load_rgb

OVERVIEW_VIEWS = 4
TILE = 360
CAPTION = 34
GAP = 4


@dataclass(frozen=True)
class TestView:
    """The pictures of one test view: paths of PNG files; `opaque` is the result as a mesh viewer draws it."""

    name: str
    truth: Path
    render: Path
    opaque: Path


def find_test_views(folder: Path, opaque: str) -> list[TestView]:
    """Test views that have all three pictures, by name.

    Args:
        folder: where a run keeps them.
        opaque: what the third is called: "mesh", or "opaque" of a soup.
    """
    names = sorted(path.name.removesuffix("_render.png") for path in folder.glob("*_render.png"))
    views = [TestView(name, *(folder / f"{name}_{kind}.png" for kind in ("truth", "render", opaque))) for name in names]
    return [view for view in views if view.truth.is_file() and view.opaque.is_file()]


def draw_overview(views: list[TestView], opaque: str) -> Image.Image:
    """The contact sheet: a column for each of up to four of one or more views; rows truth, render, and `opaque`."""
    views = spread(views, OVERVIEW_VIEWS)
    rows = {"truth": "truth", "render": "render", "opaque": opaque}
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
    return sheet


def spread(views: Sequence[TestView], count: int) -> list[TestView]:
    """At most `count` of the views, evenly spaced, the first one among them."""
    step = max(1.0, len(views) / count)
    return [views[int(index * step)] for index in range(min(count, len(views)))]


def _tile(path: Path) -> Image.Image:
    image = load_rgb(path)
    scale = TILE / max(image.size)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.LANCZOS if scale < 1 else Image.Resampling.NEAREST)
