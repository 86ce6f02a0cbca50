"""What a finished run prints: a picture, the metrics, the paths to open."""

from pathlib import Path

from PIL import Image
from rich.console import Console
from rich.table import Table
from rich.text import Text

from etsplat.report.cards import cards_of
from etsplat.report.data import read_run

PICTURE_COLUMNS = 96

_FILES = (
    ("report.html", "everything on one page"),
    ("overview.png", "test views: truth, render, and as opaque triangles"),
    ("soup.safetensors", "the soup: etsplat view, render, export and eval take its folder"),
    ("mesh.glb", "the mesh for viewers (also mesh.obj and mesh.ply)"),
    ("metrics.json", "the numbers above and more"),
)


def print_summary(console: Console, run_dir: Path) -> None:
    """Print how a run in `run_dir` ended."""
    run = read_run(run_dir)
    if console.is_terminal and console.color_system == "truecolor" and (run_dir / "overview.png").is_file():
        with Image.open(run_dir / "overview.png") as image:
            console.print(half_blocks(image, min(PICTURE_COLUMNS, console.width)))
    metrics = Table(box=None, show_header=False, pad_edge=False)
    for metric in cards_of(run):
        unit = metric.unit if metric.value is not None else "not measured; report.html says why"
        metrics.add_row(metric.title, Text(metric.value or "-", justify="right"), Text(unit))
    console.print(metrics)
    console.print()
    for name, meaning in _FILES:
        if (run_dir / name).is_file():
            console.print(Text(f"{run_dir / name}").append(f"  {meaning}", style="dim"), soft_wrap=True)


def half_blocks(image: Image.Image, columns: int) -> Text:
    """The image in characters: each is an upper half block, two pixels above each other in two colours."""
    rows = max(1, round(image.height * columns / image.width / 2))
    pixels = image.convert("RGB").resize((columns, 2 * rows), Image.Resampling.BOX).tobytes()
    text = Text()
    for row in range(rows):
        for column in range(columns):
            upper, lower = (3 * ((2 * row + half) * columns + column) for half in (0, 1))
            style = f"#{pixels[upper : upper + 3].hex()} on #{pixels[lower : lower + 3].hex()}"
            text.append("▀", style=style)
        text.append("\n")
    return text
