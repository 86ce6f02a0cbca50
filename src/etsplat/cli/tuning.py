"""`etsplat tune`: searches for good settings."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from etsplat.cli.command import INTERRUPTED, fail
from etsplat.cli.sweeps import ManyRuns, Words, print_found
from etsplat.core.errors import InputError
from etsplat.tasks.reconstruct_config import Preset as ReconstructPreset
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train_config import Preset as TrainPreset
from etsplat.tasks.train_config import SceneType, TrainConfig

if TYPE_CHECKING:
    from etsplat.tasks.sweeps.cells import Cell
    from etsplat.tasks.sweeps.tuning import Search, Study


@dataclass(frozen=True, kw_only=True)
class Tune(ManyRuns):
    """Base of the searches."""

    search: Words
    """A setting that is searched, by its dotted name: --search optimizer.lr_vertices 0.001 0.1 log.
    Its least and largest number, and log where factors matter; or words: --search drawing.colors face vertex.
    May be given several times."""
    goal: str
    """What is searched for: a number of metrics.json, mean over the inputs."""
    trials: int = 20
    """How many in all, those of earlier calls too."""
    batch: int = 1
    """How many are proposed at once, to run beside each other: more are done sooner, but know less of each other."""
    seed: int = 0
    """Of the runs, and of what is proposed."""

    def run(self, arguments: Sequence[str]) -> int:
        """Goes on until there are enough trials, then writes the best settings, tables and the page."""
        from etsplat.tasks.sweeps.tuning import Study

        for name, value in (("trials", self.trials), ("batch", self.batch)):
            if value < 1:
                raise InputError(f"{name}: is {value}; it must be at least 1")
        search = self._search(arguments)
        where, study = self.where(), Study(search)
        try:
            study.run(self.trials, self.batch, where, self._watching)
        except KeyboardInterrupt:
            fail("interrupted; give the same command to go on", INTERRUPTED)
        return self._report(search, study, arguments)

    def _search(self, arguments: Sequence[str]) -> "Search[Any]":
        from etsplat.tasks.sweeps import sweep, tuning

        inputs = sweep.read_inputs(self.sources, self.CONFIG.TASK)
        if not inputs:
            raise InputError("nothing to run: name at least one input")
        fixed = sweep.read_values(self.CONFIG, self.set)
        if several := [name for name, values in fixed.items() if len(values) > 1]:
            raise InputError(f"set {several[0]}: has several values; search among them with --search")
        base = self.base(arguments).changed({name: values[0] for name, values in fixed.items()})
        ranges = tuning.read_ranges(self.CONFIG, self.search)
        images, out = getattr(self, "images", None), self.out.absolute()
        return tuning.Search(base, ranges, inputs, self.goal, self.seed, out, images, self.store)

    def _watching(self, cells: "list[Cell]") -> Any:
        """Says of each run how it ended."""
        told: set[str] = set()

        def show() -> None:
            for cell in cells:
                ended = cell.error if cell.state == "failed" else "done" if cell.state == "done" else ""
                if ended and str(cell.folder) not in told:
                    told.add(str(cell.folder))
                    value = (
                        f"{self.goal} {cell.metrics().get(self.goal):.6g}" if ended == "done" else f"failed: {ended}"
                    )
                    print(f"  {cell.variant}, {cell.object}: {value}", flush=True)

        return show

    def _report(self, search: "Search[Any]", study: "Study", arguments: Sequence[str]) -> int:
        from etsplat.cli.live_table import conclude
        from etsplat.report.sweep_page import write_sweep_page
        from etsplat.report.sweep_rows import gather, write_rows

        chosen = {f"trial {number}": params for number, params in study.chosen().items()}
        cells = [cell for number, params in study.chosen().items() for cell in search.cells(number, params)]
        best = study.write_best()
        for cell in cells:
            cell.state = "failed" if cell.state != "done" else "done"
        if best is not None:
            found = gather(cells, chosen, self.CONFIG.TASK, self.command_line(arguments), "search", self.goal)
            write_rows(found, search.out)
            page = write_sweep_page(found, self.out)
            print_found(found)
            print(f"{self.out / best[0].name}: the best settings ({self.goal} {best[1]:.6g}), for --config")
            print(f"{page}: tables, charts and pictures; search.csv, search.json; each run under runs/")
        return conclude(cells)


@dataclass(frozen=True, kw_only=True)
class TuneReconstruct(Tune):
    """Search settings with which meshes are reconstructed best.

    Needs optuna: pip install 'etsplat[tune]'.

    Examples:
        etsplat tune reconstruct bunny.obj --out runs/rates --search optimizer.lr_vertices 0.001 0.1 log
        etsplat tune reconstruct a.obj b.obj --out runs/tuned --search drawing.colors face vertex --goal psnr
    """

    CONFIG = ReconstructConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "quick"}

    out: Path
    """Folder for the runs, the study, tables and the page; what was interrupted goes on where it was."""
    preset: ReconstructPreset = "quick"
    """Settings of all runs, before what is set."""
    goal: str = "chamfer"
    """What is searched for, mean over the inputs: chamfer, psnr, ssim, flip or silhouette_iou."""


@dataclass(frozen=True, kw_only=True)
class TuneTrain(Tune):
    """Search settings with which soups show scenes best.

    Needs optuna: pip install 'etsplat[tune]'.

    Examples:
        etsplat tune train scenes/fox --out runs/tuned --search loss.lambda_dssim 0.05 0.5 --trials 30
    """

    CONFIG = TrainConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "quick", "scene_type": "outdoor"}

    out: Path
    """Folder for the runs, the study, tables and the page; what was interrupted goes on where it was."""
    preset: TrainPreset = "quick"
    """Settings of all runs, before what is set."""
    scene_type: SceneType = "outdoor"
    """What is photographed: outdoor, indoor, or an object."""
    images: str | None = None
    """Folder in the scenes to take the photos from, such as images_4."""
    goal: str = "psnr"
    """What is searched for, mean over the inputs: psnr, ssim, flip or psnr_opaque."""
