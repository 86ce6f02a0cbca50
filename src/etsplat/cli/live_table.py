"""How a grid stands: a live table on a terminal, a line for every finished run elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from etsplat.cli.command import FAILED
from etsplat.tasks.sweeps.cells import Cell


@dataclass(frozen=True)
class Headline:
    """The number that stands for a run: its title, its key in metrics.json, a factor and a format."""

    title: str
    key: str
    factor: float
    form: str

    def text(self, cell: Cell) -> str:
        """Of a finished run; a dash if it was not measured."""
        value = cell.metrics()[self.key]
        return "-" if value is None else f"{self.factor * value:{self.form}}"


CHAMFER = Headline("Chamfer distance x 1000", "chamfer", 1e3, ".3f")
PSNR = Headline("PSNR, dB", "psnr", 1.0, ".2f")


class LiveTable:
    """Objects by variants: the headline of finished runs, percent done of running ones."""

    def __init__(self, console: Console, cells: Sequence[Cell], headline: Headline = CHAMFER) -> None:
        self._console = console
        self._headline = headline
        self._cells = cells
        self._told: set[int] = set()
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None

    def __enter__(self) -> "LiveTable":
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self) -> None:
        """Shows how the cells stand now."""
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
            return
        ended = [index for index, cell in enumerate(self._cells) if cell.state in ("done", "failed")]
        for index in ended:
            if index not in self._told:
                self._told.add(index)
                cell = self._cells[index]
                name = f"{cell.object}, {cell.variant}, seed {cell.seed}"
                print(f"  {len(ended)}/{len(self._cells)} {name}: {_result(cell, self._headline)}", flush=True)

    def _table(self) -> Table:
        variants = list(dict.fromkeys(cell.variant for cell in self._cells))
        table = Table("object", *variants, box=None, title=self._headline.title, title_justify="left")
        for name in dict.fromkeys(cell.object for cell in self._cells):
            row = []
            for variant in variants:
                cells = [cell for cell in self._cells if cell.object == name and cell.variant == variant]
                row.append(Text(" ").join(_short(cell, self._headline) for cell in cells))
            table.add_row(name, *row)
        return table


def conclude(cells: Sequence[Cell]) -> int:
    """Names the runs that failed; returns the exit status."""
    failed = [cell for cell in cells if cell.state == "failed"]
    for cell in failed:
        print(f"{cell.object}, {cell.variant}, seed {cell.seed}: failed: {cell.error}; {cell.log} has more")
    return FAILED if failed else 0


def _result(cell: Cell, headline: Headline) -> str:
    if cell.state == "failed":
        return f"failed: {cell.error}"
    return f"{headline.title} {headline.text(cell)}, {cell.metrics()['seconds']:.0f} s"


def _short(cell: Cell, headline: Headline) -> Text:
    if cell.state == "done":
        return Text(headline.text(cell), style="bold")
    if cell.state == "running":
        return Text(f"{100 * cell.progress():.0f} %", style="cyan")
    return Text("failed", style="red") if cell.state == "failed" else Text("·", style="dim")
