"""`etsplat reconstruct` and `etsplat demo`: shape reconstruction with a progress bar and a report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from etsplat.cli.command import Command, Flag, preset_of
from etsplat.cli.running import run_task
from etsplat.tasks.reconstruct_config import PRESETS, ReconstructConfig

if TYPE_CHECKING:
    from etsplat.cli.progress import RunProgress

Settings = Annotated[ReconstructConfig, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """Reconstruct an object that is built in code: nothing to download, nothing to choose."""

    EXAMPLES: ClassVar[str] = """
    etsplat demo
    etsplat demo --out owl --method bilateral
    etsplat demo --preset tiny --overwrite
    """

    settings: Settings
    out: Path = Path("runs/demo")
    """Folder for the results."""
    overwrite: Flag = False
    """Replace an earlier run in the folder."""
    resume: Flag = False
    """Continue an interrupted run in the folder."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Demo":
        """The preset's settings."""
        return cls(settings=preset_of(arguments, PRESETS, "demo"))

    def run(self, arguments: Sequence[str]) -> int:
        """Reconstructs the built-in object."""
        return _run("demo:owl", None, None, self, arguments)


@dataclass(frozen=True, kw_only=True)
class Reconstruct(Command):
    """Deform a sphere into the object that pictures show."""

    EXAMPLES: ClassVar[str] = """
    etsplat reconstruct bunny.obj --out runs/bunny --preset quick
    etsplat reconstruct bunny.obj --out runs/bunny
    etsplat reconstruct bunny.obj --out runs/bunny --resume
    etsplat reconstruct bunny.obj --out runs/paper --preset paper --method bilateral
    etsplat reconstruct my_scene/ --out runs/scene --iterations 4000
    """

    source: tyro.conf.Positional[Path]
    """A mesh file, which is photographed from 40 sides; or a folder with posed images (transforms.json or COLMAP)."""
    out: Path
    """Folder for the results: mesh.ply, mesh.obj, mesh.glb, metrics.json, report.html and more."""
    settings: Settings
    init_mesh: Path | None = None
    """Start from this mesh instead of a sphere; in the units of the source."""
    masks: Path | None = None
    """Folder with a mask (white inside the object) for every image; else masks/ of the source, or transparency."""
    overwrite: Flag = False
    """Replace an earlier run in the folder."""
    resume: Flag = False
    """Continue an interrupted run in the folder; give the same options as then."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Reconstruct":
        """The preset's settings."""
        return cls(source=tyro.MISSING, out=tyro.MISSING, settings=preset_of(arguments, PRESETS, "best"))

    def run(self, arguments: Sequence[str]) -> int:
        """Reconstructs what the source shows."""
        return _run(self.source, self.init_mesh, self.masks, self, arguments)


def _run(
    source: Path | str,
    init_mesh: Path | None,
    masks: Path | None,
    command: Demo | Reconstruct,
    arguments: Sequence[str],
) -> int:
    from etsplat.tasks.reconstruct import reconstruct

    def task(progress: "RunProgress") -> None:
        reconstruct(
            source,
            command.out,
            command.settings,
            init_mesh=init_mesh,
            masks=masks,
            callbacks=[progress],
            resume=command.resume,
            overwrite=command.overwrite,
        )

    return run_task(task, command.out, arguments, debug=command.debug, preparing="Taking pictures")
