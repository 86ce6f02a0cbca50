"""`python -m studies.opensplat`: our soups beside OpenSplat's Gaussians, both on the CPU."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from etsplat.cli.command import INTERRUPTED, fail
from etsplat.core.errors import InputError
from etsplat.tasks.train_config import Preset, TrainConfig
from studies.peers.settings import Schedule
from studies.study import Study


@dataclass(frozen=True, kw_only=True)
class OpenSplat(Study):
    r"""Captures with our method and with OpenSplat, on the CPU: as many steps, and as many processor seconds.

    The same photos, split and scores; gsplat's PyTorch twins draw OpenSplat's Gaussians, and that is checked against
    its own picture. Captures must have points, no masks, and their principal points in the middle of the photos.

    Examples:
        python -m studies.opensplat --opensplat OpenSplat/build/opensplat --set width=200 \
            --scenes scenes/banana:indoor scenes/family --out runs/opensplat
    """

    scenes: tuple[str, ...]
    """Folders of the captures, each with its kind and changes after a colon: FOLDER:indoor, FOLDER:outdoor."""
    out: Path
    """Folder for the runs and the table; runs that are finished are not repeated."""
    opensplat: Path | None = None
    """OpenSplat's program."""
    schedule: Schedule = "scaled"
    """Its schedule, which is for 30,000 steps: scaled to the length of a run, or its own."""
    equal_steps: bool = True
    """Let OpenSplat take as many steps as we do as well, however long that takes."""
    preset: Preset = "quick"
    """Settings of our runs."""
    set: str = ""
    """More changes for our runs, such as width=200; OpenSplat has the same photos."""
    seed: int = 0
    """Of our runs; OpenSplat has its own."""

    def run(self, arguments: Sequence[str]) -> int:
        """Checks all captures, runs what is not finished yet, then writes the table."""
        from etsplat.data.load import load_dataset
        from etsplat.engines.threads import num_threads
        from studies import gsplat_on_cpu
        from studies.peers import opensplat
        from studies.scenes.cells import make_nvs_cells, read_scene_argument
        from studies.scenes.opensplat import compare, write_comparison

        if self.opensplat is None:
            raise InputError(f"opensplat: name its program; {opensplat.BUILD}")
        gsplat, _ = gsplat_on_cpu.load_gsplat_on_cpu()
        cells = make_nvs_cells(
            [read_scene_argument(scene) for scene in self.scenes],
            ["elastic"],
            self.out,
            preset=self.preset,
            culling=(False,),
            setting=self.set,
            seeds=(self.seed,),
        )
        peers = []
        for cell in cells:
            assert isinstance(cell.config, TrainConfig)
            capture = load_dataset(cell.source, images=cell.images, width=cell.config.width).normalized()
            folder = cell.folder.parent / "opensplat"
            program = opensplat.Program(self.opensplat, gsplat, num_threads(), self.schedule)
            peers.append(opensplat.OpenSplat(program, cell.object, capture, folder))
        found = []
        try:
            for cell, peer in zip(cells, peers, strict=True):
                found.append(compare(cell, peer, equal_steps=self.equal_steps))
                write_comparison(found, self.out, self.command_line(arguments))
                print(f"{cell.object}: done", flush=True)
        except KeyboardInterrupt:
            fail("interrupted; give the same command to go on", INTERRUPTED)
        print((self.out / "opensplat.md").read_text(encoding="utf-8"))
        print(f"{self.out}: opensplat.md, .json; each run under runs/")
        return 0


if __name__ == "__main__":
    OpenSplat.main()
