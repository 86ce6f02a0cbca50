"""`python -m studies.matrix`: one preset on every capture, size of photos and limit of triangles."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from etsplat.cli.placed import Placed
from etsplat.tasks.train_config import Preset
from studies.study import Study


@dataclass(frozen=True, kw_only=True)
class Matrix(Study, Placed):
    """Captures by widths by limits of triangles: whether a preset falls apart anywhere.

    A row is a capture at a width. No cell should be more than half a dB below the best of its row, and no row's best
    below that of an earlier matrix.

    Examples:
        python -m studies.matrix --scenes scenes/fox:indoor scenes/herzjesu-P25 --out runs/matrix
        python -m studies.matrix --scenes scenes/fox:indoor --widths 200 --limits 20000 100000 --out runs/small
        python -m studies.matrix --scenes scenes/fox:indoor --against runs/before --out runs/matrix
    """

    scenes: tuple[str, ...]
    """Folders of the captures, each with its kind and changes after a colon: FOLDER:indoor, FOLDER:object."""
    out: Path
    """Folder for the runs and the table; a matrix that was interrupted goes on where it was."""
    widths: tuple[int, ...] = (200, 400, 800)
    """Widths that photos are scaled down to."""
    limits: tuple[int, ...] = (20_000, 100_000)
    """What max_triangles is set to."""
    preset: Preset = "quick"
    """Settings of all runs."""
    set: str = ""
    """More changes for all runs, such as pixels_per_triangle=none."""
    seed: int = 0
    """Of all runs."""
    against: Path | None = None
    """Folder of an earlier matrix, whose rows' best stand beside."""
    jobs: int = 1
    """Runs beside each other; 0 for one on each core. They share the cores evenly."""

    def run(self, arguments: Sequence[str]) -> int:
        """Runs what is not finished yet, then writes the table."""
        from etsplat.cli.live_table import PSNR, conclude
        from studies.scenes.cells import make_nvs_cells, read_scene_argument
        from studies.scenes.matrix import read_bar, write_matrix

        where, bar = self.where(), read_bar(self.against) if self.against else {}
        cells = make_nvs_cells(
            [read_scene_argument(scene) for scene in self.scenes],
            ["elastic"],
            self.out,
            preset=self.preset,
            culling=(False,),
            setting=self.set,
            settings=[f"width={width},max_triangles={limit}" for width, limit in product(self.widths, self.limits)],
            seeds=(self.seed,),
        )
        self.run_cells(cells, where, PSNR)
        if any(cell.state == "done" for cell in cells):
            write_matrix(cells, self.out, self.command_line(arguments), bar)
            print((self.out / "matrix.md").read_text(encoding="utf-8"))
            print(f"{self.out}: matrix.md, .json; each run under runs/")
        return conclude(cells)


if __name__ == "__main__":
    Matrix.main()
