"""Figures nvs and trisoup of a grid of soups: test views of every scene, as splats and as opaque triangles."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from etsplat.io.atomic import atomic_write
from studies.grid.cells import Cell

TILE = 400
GAP = 4
TITLE = 26


def draw_nvs(cells: Sequence[Cell], variants: Sequence[str], path: Path, *, kind: str = "render") -> None:
    """A row for each scene: the photograph of its middle test view, and the same of every variant.

    Args:
        cells: those that are done are shown.
        variants: columns, in order.
        path: of the PNG.
        kind: "render" for figure nvs, "opaque" for figure trisoup, which peers have no picture of.
    """
    rows = []
    for scene in dict.fromkeys(cell.object for cell in cells if cell.state == "done"):
        done = {cell.variant: cell for cell in cells if cell.object == scene and cell.state == "done"}
        truths = sorted((next(iter(done.values())).folder / "test").glob("*_truth.png"))
        if truths:
            truth = truths[len(truths) // 2]
            name = truth.name.replace("_truth", f"_{kind}")
            files = [done[variant].folder / "test" / name if variant in done else None for variant in variants]
            rows.append([truth, *(file if file is not None and file.is_file() else None for file in files)])
    if not rows:
        return
    tiles = [[None if file is None else _tile(file) for file in row] for row in rows]
    heights = [max(tile.height for tile in row if tile is not None) for row in tiles]
    columns = ["photograph", *variants]
    sheet = Image.new("RGB", (len(columns) * (TILE + GAP), TITLE + sum(heights) + GAP * len(rows)), "white")
    font = ImageFont.load_default(size=16)
    for column, title in enumerate(columns):
        place = (column * (TILE + GAP) + TILE / 2, TITLE / 2)
        ImageDraw.Draw(sheet).text(place, title, fill="black", font=font, anchor="mm")
    top = TITLE
    for row, height in zip(tiles, heights, strict=True):
        for column, tile in enumerate(row):
            if tile is not None:
                sheet.paste(tile, (column * (TILE + GAP), top))
        top += height + GAP
    with atomic_write(path) as temporary:
        sheet.save(temporary)


def _tile(path: Path) -> Image.Image:
    with Image.open(path) as image:
        shown = image.convert("RGB")
    return shown.resize((TILE, max(1, round(shown.height * TILE / shown.width))), Image.Resampling.LANCZOS)
