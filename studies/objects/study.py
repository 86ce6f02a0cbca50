"""What the studies of shape reconstruction have in common: a grid of runs of `etsplat reconstruct`."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from etsplat.cli.placed import Placed
from etsplat.tasks.reconstruct_config import Preset, ReconstructConfig
from studies.grid.variants import Variant, find_meshes
from studies.study import Study

if TYPE_CHECKING:
    from studies.grid.cells import Cell


@dataclass(frozen=True, kw_only=True)
class GridStudy(Study, Placed):
    """Base of the studies that are a grid of reconstructions."""

    out: Path
    """Folder for the runs, tables and figures; a grid that was interrupted goes on where it was."""
    objects: tuple[str, ...] = ()
    """Names of the objects, without suffix; all there are if none is named."""
    preset: Preset = "study"
    """Settings of all runs; what is compared is changed on top of it."""
    set: str = ""
    """More changes for all runs, such as resolution=256,iterations=1500."""
    seeds: tuple[int, ...] = (0,)
    """Each run is repeated with each of them."""

    def base(self) -> ReconstructConfig:
        """The settings that all runs have in common."""
        preset = ReconstructConfig.of(self.preset)
        return preset.changed(preset.read_changes(self.set))


@dataclass(frozen=True, kw_only=True)
class ObjectStudy(GridStudy):
    """Base of the studies of objects: meshes by variants by seeds."""

    meshes: Path
    """Folder of mesh files, such as the paper's (`etsplat data download famous`)."""

    @abstractmethod
    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """What is compared."""

    def run(self, arguments: Sequence[str]) -> int:
        """Runs what is not finished yet, then writes tables and figures."""
        from etsplat.cli.live_table import CHAMFER, conclude
        from studies.grid.cells import make_cells

        where, base = self.where(), self.base()
        variants = self.variants(base)
        cells = make_cells(find_meshes(self.meshes, self.objects), variants, base, self.seeds, self.out)
        self.run_cells(cells, where, CHAMFER)
        self._report(cells, [variant.name for variant in variants], arguments)
        return conclude(cells)

    def _report(self, cells: list["Cell"], variants: list[str], arguments: Sequence[str]) -> None:
        from studies.objects.pictures import draw_qualitative, plot_convergence
        from studies.objects.results import rows_of
        from studies.objects.tables import write_tables

        rows = rows_of(cells)
        if not rows:
            return
        write_tables(rows, variants, self.out, self.command_line(arguments))
        plot_convergence(cells, variants, self.out / "convergence.png")
        draw_qualitative(cells, variants, self.out / "qualitative.png")
        print((self.out / "results.md").read_text(encoding="utf-8"))
        print(f"{self.out}: results.md, .csv, .json, .tex, convergence.png, qualitative.png; each run under runs/")
