"""`etsplat export`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from etsplat.cli.command import Command
from etsplat.io.writers import purposes
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.settings import Device

PURPOSES = {**purposes(), "safetensors": "For etsplat."}
if TYPE_CHECKING:
    Kind = str
else:
    Kind = Literal[tuple(PURPOSES)]
_FORMAT = "\n".join(
    ["Kind of file; by default what --out ends in, or glb.", *(f"{kind}: {use}" for kind, use in PURPOSES.items())]
)

Settings = Annotated[ExportConfig, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a trained soup for Blender, game engines or the web; or turn another program's file into a soup."""

    EXAMPLES: ClassVar[str] = """
    etsplat export runs/kitchen
    etsplat export runs/kitchen --out kitchen.ply
    etsplat export runs/kitchen --format ply --colors keep --min-opacity 0 --up keep
    etsplat export point_cloud_state_dict.pt --format safetensors
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A run of `etsplat train`; or a file: .safetensors, .pt of Triangle Splatting, Gaussian .ply, or a mesh."""
    format: Annotated[Kind | None, tyro.conf.arg(help=_FORMAT)] = None
    out: Path | None = None
    """The file to write; by default soup.FORMAT in the run's folder."""
    scene: Path | None = None
    """The capture's folder, if it has moved or a file is given: for colours as the cameras saw them, and for up."""
    device: Device | None = None
    """Where it is drawn: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    settings: Settings = field(default_factory=ExportConfig)

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Export":
        """Nothing depends on the arguments."""
        return cls(run_dir=tyro.MISSING)

    def run(self, arguments: Sequence[str]) -> int:
        """Writes the file and says what is in it."""
        from etsplat.core.errors import InputError
        from etsplat.io.paths import kind_of
        from etsplat.tasks.export_soup import export_soup
        from etsplat.tasks.soup_run import open_run

        opened = open_run(self.run_dir, self.scene, self.device)
        out = self.out or opened.folder / f"soup.{self.format or 'glb'}"
        kinds = [self.format] if self.format else list(PURPOSES)
        if kind_of(out).removeprefix(".") not in kinds:
            raise InputError(f"--out {out}: does not end in .{' or .'.join(kinds)}; rename it or change --format")
        read = self.run_dir / "soup.safetensors" if self.run_dir.is_dir() else self.run_dir
        if out.resolve() == read.resolve():
            raise InputError(f"--out {out}: is what is read; choose another file")
        written = export_soup(opened, out, self.settings)
        left_out = f", {written.dropped:,} fainter ones left out" if written.dropped else ""
        print(f"{written.path}: {written.triangles:,} triangles{left_out}")
        if written.dropped > written.triangles:
            print("Most of it is too faint to be drawn opaque; train with --finish opaque, or lower --min-opacity.")
        return 0
