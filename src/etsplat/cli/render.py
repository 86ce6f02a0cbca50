"""`etsplat render`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from etsplat.cli.command import Command
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.settings import Device

Settings = Annotated[RenderConfig, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True, kw_only=True)
class Render(Command):
    """Draw a trained soup: its test views, or a path through the scene as a video."""

    EXAMPLES: ClassVar[str] = """
    etsplat render runs/kitchen
    etsplat render runs/kitchen --path orbit --frames 240
    etsplat render runs/kitchen --path ellipse --opaque --depth --normals
    etsplat render soup.ply --scene scenes/kitchen --path interpolated --format frames
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A run of `etsplat train`; or a file with a soup, with --scene."""
    out: Path | None = None
    """Folder for the pictures; by default renders/ in the run's folder."""
    scene: Path | None = None
    """The capture's folder, if it has moved or a file is given."""
    device: Device | None = None
    """Where it is drawn: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    settings: Settings = field(default_factory=RenderConfig)

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Render":
        """Nothing depends on the arguments."""
        return cls(run_dir=tyro.MISSING)

    def run(self, arguments: Sequence[str]) -> int:
        """Draws, and says where the pictures are."""
        from rich.console import Console

        from etsplat.cli.phases import PhaseBar
        from etsplat.tasks.render_soup import render_run
        from etsplat.tasks.soup_run import open_run

        opened = open_run(self.run_dir, self.scene, self.device)
        out = self.out or opened.folder / "renders"
        with PhaseBar(Console()) as bar:
            files = render_run(
                opened, out, self.settings, progress=lambda done, total: bar.show("Drawing", done, total)
            )
        print(f"{len(files)} files in {out}" if len(files) != 1 else files[0])
        return 0
