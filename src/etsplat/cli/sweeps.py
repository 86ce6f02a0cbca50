"""`etsplat sweep`: any settings against each other, on any inputs."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from etsplat.cli.command import settings_before_options
from etsplat.cli.placed import Placed
from etsplat.core.errors import InputError
from etsplat.tasks.reconstruct_config import Preset as ReconstructPreset
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Settings
from etsplat.tasks.train_config import Preset as TrainPreset
from etsplat.tasks.train_config import SceneType, TrainConfig

if TYPE_CHECKING:
    from etsplat.report.sweep_rows import Found

Words = tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]]
"""An option that may be given several times, each time with several words."""


@dataclass(frozen=True, kw_only=True)
class ManyRuns(Placed):
    """Base of the commands whose runs have settings by option."""

    CONFIG: ClassVar[type[Settings]]
    """Of the runs."""
    PRESET: ClassVar[dict[str, str]]
    """What the settings start from, where nobody says otherwise."""

    sources: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="INPUT ...", help_behavior_hint="(required, one or more)"),
    ]
    """What `etsplat reconstruct` or `etsplat train` takes, or what the demo shows: demo:owl, demo:scene."""
    out: Path
    """Folder for the runs, tables and the page; what was interrupted goes on where it was."""
    config: Path | None = None
    """Settings to begin with: config.json of a run, or a JSON file with some of them."""
    set: Words = ()
    """A setting and its value, by its dotted name, such as --set iterations 500. May be given several times."""
    store: str | None = None
    """Keep run directories at a URL of fsspec as well, such as s3://BUCKET/FOLDER.
    Machines of a cluster then need no common folder."""

    def base(self, arguments: Sequence[str]) -> Any:
        """The settings that all runs have in common."""
        return settings_before_options(self.CONFIG, arguments, **self.PRESET)

    def command_line(self, arguments: Sequence[str]) -> str:
        """What somebody types to get the same again."""
        return f"etsplat {shlex.join(arguments)}"


@dataclass(frozen=True, kw_only=True)
class Sweep(ManyRuns):
    """Base of the sweeps."""

    set: Words = ()
    """A setting and its values, by its dotted name; every combination is run.
    May be given several times: --set iterations 500 --set optimizer.lr_vertices 0.003 0.006."""
    seeds: tuple[int, ...] = (0,)
    """Each combination is run with each of them; tables have the means."""

    def run(self, arguments: Sequence[str]) -> int:
        """Runs what is not finished yet, then writes tables and the page."""
        from etsplat.cli.live_table import CHAMFER, PSNR, conclude
        from etsplat.report.sweep_page import write_sweep_page
        from etsplat.report.sweep_rows import gather, write_rows
        from etsplat.tasks.sweeps import sweep

        task, where = self.CONFIG.TASK, self.where()
        inputs = sweep.read_inputs(self.sources, task)
        if not inputs:
            raise InputError("nothing to run: name at least one input")
        values = sweep.read_values(self.CONFIG, self.set)
        images = getattr(self, "images", None)
        whole = sweep.Sweep(self.base(arguments), values, inputs, self.seeds, images, self.config is None)
        cells = whole.cells(self.out.absolute(), self.store)
        self.run_cells(cells, where, CHAMFER if task == "reconstruct" else PSNR)
        chosen = {sweep.name_of(one): one for one in whole.combinations()}
        if any(cell.state == "done" for cell in cells):
            found = gather(cells, chosen, task, self.command_line(arguments))
            write_rows(found, self.out.absolute())
            page = write_sweep_page(found, self.out)
            print_found(found)
            print(f"{page}: tables, charts and pictures; sweep.csv, sweep.json; each run under runs/")
        return conclude(cells)


@dataclass(frozen=True, kw_only=True)
class SweepReconstruct(Sweep):
    """Reconstruct meshes with any settings against each other.

    Examples:
        etsplat sweep reconstruct bunny.obj --out runs/rates --set optimizer.lr_vertices 0.01 0.02
        etsplat sweep reconstruct a.obj b.obj --out runs/colors --set drawing.colors face vertex --seeds 0 1 2
        etsplat sweep reconstruct demo:owl --out runs/kernels --preset tiny --set method elastic bilateral
    """

    CONFIG = ReconstructConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "quick"}

    preset: ReconstructPreset = "quick"
    """Settings of all runs, before what is set."""


@dataclass(frozen=True, kw_only=True)
class SweepTrain(Sweep):
    """Fit soups with any settings against each other.

    Examples:
        etsplat sweep train scenes/fox --out runs/limits --set max_triangles 20000 50000 --set width 400
        etsplat sweep train scenes/fox scenes/garden --out runs/kernels --set method elastic bilateral --seeds 0 1
    """

    CONFIG = TrainConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "quick", "scene_type": "outdoor"}

    preset: TrainPreset = "quick"
    """Settings of all runs, before what is set."""
    scene_type: SceneType = "outdoor"
    """What is photographed: outdoor, indoor, or an object."""
    images: str | None = None
    """Folder in the scenes to take the photos from, such as images_4."""


def print_found(found: "Found") -> None:
    """Prints the table of combinations, and which is best."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from etsplat.report.sweep_rows import summary
    from etsplat.tasks.sweeps.sweep import short_names, shown

    measures = [measure for measure in found.measures if measure.key != "flip"]  # for which a terminal has no room
    table = Table(box=None)
    for title in [*(["input"] if len(found.inputs) > 1 else []), *short_names(found.varied).values()]:
        table.add_column(title, no_wrap=True)
    for measure in measures:
        table.add_column(measure.title, justify="right")
    for line in found.lines:
        row = [line.input] if len(found.inputs) > 1 else []
        row += [shown(line.chosen[name]) for name in found.varied]
        best = [found.best(line.input, measure) is line for measure in measures]
        texts = [Text(line.text(m), style="bold" if b else "") for m, b in zip(measures, best, strict=True)]
        table.add_row(*row, *texts)
    console = Console()
    console.print(table)
    if said := summary(found):
        console.print(said, soft_wrap=True, highlight=False)
