"""`etsplat reconstruct` and `etsplat demo object`: shape reconstruction with a progress bar and a report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from etsplat.cli.command import settings_before_options
from etsplat.cli.running import RunCommand
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Rare

if TYPE_CHECKING:
    from etsplat.cli.progress import RunProgress

Settings = Annotated[ReconstructConfig, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class DemoObject(RunCommand):
    """Reconstruct an object that is built in code: nothing to download, nothing to choose."""

    EXAMPLES: ClassVar[str] = """
    etsplat demo object
    etsplat demo object --out owl --method bilateral
    etsplat demo object --preset tiny --overwrite
    """
    PREPARING: ClassVar[str] = "Taking pictures"

    out: Path = Path("runs/demo")
    """Folder for the results."""
    settings: Settings

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "DemoObject":
        """The preset's settings."""
        return cls(settings=settings_before_options(ReconstructConfig, arguments, preset="demo"))

    def task(self, progress: "RunProgress") -> None:
        """Reconstructs the built-in object."""
        from etsplat.tasks.reconstruct import reconstruct

        reconstruct("demo:owl", self.out, self.settings, callbacks=[progress], **self.place)


@dataclass(frozen=True, kw_only=True)
class Reconstruct(RunCommand):
    """Deform a sphere into the object that pictures show."""

    EXAMPLES: ClassVar[str] = """
    etsplat reconstruct bunny.obj --out runs/bunny --preset quick
    etsplat reconstruct bunny.obj --out runs/bunny
    etsplat reconstruct bunny.obj --out runs/bunny --resume
    etsplat reconstruct bunny.obj --out runs/paper --preset paper --method bilateral
    etsplat reconstruct boot.obj --out runs/boot --config runs/bunny/config.json
    etsplat reconstruct my_scene/ --out runs/scene --iterations 4000
    """
    PREPARING: ClassVar[str] = "Taking pictures"

    source: tyro.conf.Positional[Path]
    """A mesh file, which is photographed from 40 sides; or a folder with posed images (transforms.json or COLMAP)."""
    out: Path
    """Folder for the results: mesh.ply, mesh.obj, mesh.glb, metrics.json, report.html and more."""
    settings: Settings
    init_mesh: Annotated[Path | None, Rare] = None
    """Start from this mesh instead of a sphere; in the units of the source."""
    masks: Annotated[Path | None, Rare] = None
    """Folder with a mask (white inside the object) for every image; else masks/ of the source, or transparency."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Reconstruct":
        """The preset's settings."""
        settings = settings_before_options(ReconstructConfig, arguments, preset="best")
        return cls(source=tyro.MISSING, out=tyro.MISSING, settings=settings)

    def task(self, progress: "RunProgress") -> None:
        """Reconstructs what the source shows."""
        from etsplat.tasks.reconstruct import reconstruct

        reconstruct(
            self.source,
            self.out,
            self.settings,
            init_mesh=self.init_mesh,
            masks=self.masks,
            callbacks=[progress],
            **self.place,
        )
