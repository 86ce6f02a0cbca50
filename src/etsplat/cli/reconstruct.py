"""`etsplat reconstruct` and `etsplat demo`: shape reconstruction with a progress bar and a report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from etsplat.cli.command import FAILED, INTERRUPTED, Command, fail, preset_of, resume_line
from etsplat.tasks.reconstruct_config import PRESETS, ReconstructConfig

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
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    resume: bool = False
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
    etsplat reconstruct bunny.obj --out runs/bunny
    etsplat reconstruct bunny.obj --out runs/bunny --preset paper
    etsplat reconstruct bunny.obj --out runs/bunny --preset paper --resume
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
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    resume: bool = False
    """Continue an interrupted run in the folder; give the same options as then."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Reconstruct":
        """The preset's settings."""
        return cls(source=tyro.MISSING, out=tyro.MISSING, settings=preset_of(arguments, PRESETS, "quick"))

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
    from rich.console import Console

    from etsplat.cli.progress import RunProgress
    from etsplat.cli.summary import print_summary
    from etsplat.io.run_directory import is_run
    from etsplat.optim.loop import DivergedError
    from etsplat.report import write_report
    from etsplat.tasks.reconstruct import reconstruct

    console = Console()
    try:
        with RunProgress(console) as progress:
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
            progress.say("Writing the report")
            write_report(command.out)
    except KeyboardInterrupt:
        if not is_run(command.out):
            raise
        fail(f"interrupted; continue with: {resume_line(arguments)}", INTERRUPTED)
    except DivergedError as error:
        if command.debug:
            raise
        fail(str(error), FAILED)
    print_summary(console, command.out)
    return 0
