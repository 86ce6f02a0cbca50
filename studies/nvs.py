"""`python -m studies.nvs`: the paper's tables and figures of novel-view synthesis."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from etsplat.cli.command import INTERRUPTED, fail
from etsplat.cli.placed import Placed
from etsplat.tasks.settings import SoftMethod
from etsplat.tasks.train_config import Preset
from studies.peers.settings import Peer
from studies.study import Study


@dataclass(frozen=True, kw_only=True)
class Nvs(Study, Placed):
    """The paper's tables nvs, per-scene, filter and efficiency, and its figures nvs and trisoup.

    Scenes of the paper get Triangle Splatting's settings for them with `--preset paper`.

    Examples:
        python -m studies.nvs --scenes scenes/kitchen:indoor scenes/lego:object,background=white --out runs/nvs
        python -m studies.nvs --scenes scenes/fox:indoor --out runs/filter --methods elastic --culling both
        python -m studies.nvs --scenes scenes/fox:indoor --out runs/small --set iterations=1000,width=300
        python -m studies.nvs --scenes demo:scene --settings "" pruning.views=2 start.limit=none --out runs/ablation
        python -m studies.nvs --scenes data/tandt/truck data/tandt/train --out runs/tandt --preset paper --culling on
        python -m studies.nvs --scenes scenes/kitchen --out runs/peers --methods elastic 3dgs 2dgs
    """

    scenes: tuple[str, ...]
    """Folders of the scenes, or demo:scene for the one that is built in code.
    Their kind (outdoor if not given) and changes come after a colon: FOLDER:indoor, FOLDER:object,background=white."""
    out: Path
    """Folder for the runs, tables and figures; a grid that was interrupted goes on where it was."""
    methods: tuple[SoftMethod | Peer, ...] = ("elastic", "bilateral", "single-sided")
    """Which kernels; 3dgs and 2dgs are Gaussian peers, which need gsplat (pip install --group studies) and a GPU."""
    culling: Literal["off", "on", "both"] = "off"
    """Leave out triangles with an inradius below a pixel: the paper's rows were measured with it on."""
    settings: tuple[str, ...] = ("",)
    """What is compared beside methods: lists of changes such as pruning.views=2,start.limit=none; "" is the preset."""
    seeds: tuple[int, ...] = (0,)
    """Each run is repeated with each of them; tables have the means."""
    preset: Preset = "quick"
    """Settings of all runs."""
    set: str = ""
    """More changes for all runs, such as iterations=1500,width=400."""
    jobs: int = 1
    """Runs beside each other; 0 for one on each core. They share the cores evenly."""
    lpips_weights: Path | None = None
    """File with LPIPS's weights, or `download`."""

    def run(self, arguments: Sequence[str]) -> int:
        """Runs what is not finished yet, measures it, then writes tables and figures."""
        from etsplat.cli.live_table import PSNR, conclude
        from etsplat.cli.progress import PhaseBar
        from studies.scenes.cells import evaluate_cells, make_nvs_cells, read_scene_argument

        where = self.where()
        cells = make_nvs_cells(
            [read_scene_argument(scene) for scene in self.scenes],
            self.methods,
            self.out,
            preset=self.preset,
            culling={"off": (False,), "on": (True,), "both": (False, True)}[self.culling],
            setting=self.set,
            settings=self.settings,
            seeds=self.seeds,
        )
        self.run_cells(cells, where, PSNR)
        try:
            with PhaseBar() as bar:
                rows = evaluate_cells(cells, self.lpips_weights, lambda done, total: bar.show("Measuring", done, total))
        except KeyboardInterrupt:
            fail("interrupted; give the same command to go on", INTERRUPTED)
        if rows:
            self._report(cells, rows, arguments)
        return conclude(cells)

    def _report(self, cells: list, rows: list[dict[str, Any]], arguments: Sequence[str]) -> None:
        from studies.scenes.pictures import draw_nvs
        from studies.scenes.tables import write_nvs_tables

        write_nvs_tables(rows, self.out, self.command_line(arguments))
        variants = list(dict.fromkeys(row["variant"] for row in rows))
        draw_nvs(cells, variants, self.out / "nvs.png")
        draw_nvs(cells, variants, self.out / "trisoup.png", kind="opaque")
        print((self.out / "nvs.md").read_text(encoding="utf-8"))
        print(f"{self.out}: nvs.md, .csv, .json, .tex, nvs.png, trisoup.png; each run under runs/")


if __name__ == "__main__":
    Nvs.main()
