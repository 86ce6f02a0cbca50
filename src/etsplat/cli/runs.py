"""The commands that make a run: `etsplat reconstruct`, `etsplat train` and both `etsplat demo`."""

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from etsplat.cli.command import FAILED, INTERRUPTED, Command, Flag, fail, resume_line, settings_before_options
from etsplat.core.errors import InputError
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Rare, Settings
from etsplat.tasks.train_config import TrainConfig

if TYPE_CHECKING:
    from etsplat.optim.loop import Callback
    from etsplat.viewer.live import LiveView

VIEW_WIDTH = 960
"""Pixels of the pictures of a run that is watched, when the camera stands still."""


@dataclass(frozen=True, kw_only=True)
class RunCommand(Command):
    """Base of the commands that make a run: options, progress, report, summary, and how a run ends early."""

    CONFIG: ClassVar[type[Settings]]
    """Of `settings`. The function of `etsplat` that makes the run is called as its task."""
    PRESET: ClassVar[dict[str, str]]
    """What the settings start from, where nobody says otherwise."""
    SOURCE: ClassVar[str | None] = None
    """What is shown; None where `source` is an option."""
    INPUT: ClassVar[tuple[str, ...]] = ()
    """Options that the function takes too."""
    PREPARING: ClassVar[str] = "Taking pictures"
    """What happens before the first step."""

    help_all: Flag = False
    """Show every option, and every setting under its heading."""
    debug: Annotated[Flag, Rare] = False
    """Show the traceback of an error."""
    out: Path
    """Folder for the results."""
    config: Path | None = None
    """Settings to begin with: config.json of a run, or a JSON file with some of them. Options go over it."""
    kernel_file: Annotated[Path | None, Rare] = None
    """A Python file that registers the kernel named by --method (etsplat.register_kernel). It is run."""
    overwrite: Flag = False
    """Replace an earlier run in the folder."""
    resume: Flag = False
    """Continue an interrupted run in the folder; give the same options as then."""
    settings: Settings

    @classmethod
    def defaults(cls, arguments: Sequence[str], **known: Any) -> Any:
        """With the preset's settings."""
        settings = settings_before_options(cls.CONFIG, arguments, **cls.PRESET)
        return super().defaults(arguments, settings=settings, **known)

    def callbacks(self) -> "list[Callback]":
        """What is told of the run beside the progress bar."""
        return []

    def onlooker(self) -> "LiveView | None":
        """Who watches the run, beside the callbacks; None where nobody does."""
        return None

    def run(self, arguments: Sequence[str]) -> int:
        """Does the run with a progress bar, writes its report and prints what came out.

        Of several workers the first does so, and of those that end early one says why.
        """
        import etsplat
        from etsplat.core.workers import WorkerLostError, together
        from etsplat.io.run_directory import is_run

        try:
            with together() as group:
                try:
                    self._do() if group.leads else self._make([])
                except BaseException as error:
                    if not group.first_to_report():
                        sys.exit(INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED)
                    raise
        except KeyboardInterrupt:
            if not is_run(self.out):
                raise
            fail(f"interrupted; continue with: {resume_line(arguments)}", INTERRUPTED)
        except (etsplat.DivergedError, WorkerLostError) as error:
            if self.debug:
                raise
            remedy = "" if isinstance(error, etsplat.DivergedError) else "; start all workers again with --resume"
            fail(f"{error}{remedy}", FAILED)
        return 0

    def _do(self) -> None:
        from rich.console import Console

        import etsplat
        from etsplat.cli.progress import RunProgress, print_summary

        console, live = Console(), self.onlooker()
        with live or nullcontext():
            with RunProgress(console, preparing=self.PREPARING) as progress:
                progress.show("Reading the input")
                result = self._make([progress, *([live] if live else []), *self.callbacks()], live)
                progress.show("Writing the report")
                etsplat.write_report(self.out)
            print_summary(console, self.out)
            if live:
                live.finish(result.soup)
                live.stay(print)

    def _make(self, callbacks: "list[Callback]", live: "LiveView | None" = None) -> Any:
        """Calls the task."""
        import etsplat

        options = vars(self)
        return getattr(etsplat, self.CONFIG.TASK)(
            options.get("source", self.SOURCE),
            self.out,
            self.settings,
            **{name: options[name] for name in self.INPUT},
            **({"onlooker": live.look} if live else {}),
            callbacks=callbacks,
            resume=self.resume,
            overwrite=self.overwrite,
        )


@dataclass(frozen=True, kw_only=True)
class DemoObject(RunCommand):
    """Reconstruct an object that is built in code: nothing to download, nothing to choose.

    Examples:
        etsplat demo object
        etsplat demo object --out owl --method bilateral
        etsplat demo object --preset tiny --overwrite
    """

    CONFIG = ReconstructConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "demo"}
    SOURCE = "demo:owl"

    out: Path = Path("runs/demo")
    """Folder for the results."""
    settings: Annotated[ReconstructConfig, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Reconstruct(RunCommand):
    """Deform a sphere, or the visual hull, into the object that pictures show.

    Examples:
        etsplat reconstruct bunny.obj --out runs/bunny --preset quick
        etsplat reconstruct bunny.obj --out runs/bunny
        etsplat reconstruct bunny.obj --out runs/bunny --resume
        etsplat reconstruct bunny.obj --out runs/paper --preset paper --method bilateral
        etsplat reconstruct boot.obj --out runs/boot --config runs/bunny/config.json
        etsplat reconstruct my_scene/ --out runs/scene --iterations 4000
        etsplat reconstruct my_scene/ --out runs/asset --texture 2048
    """

    CONFIG = ReconstructConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "best"}
    INPUT = ("init_mesh", "masks", "depths", "depth_unit")

    source: tyro.conf.Positional[Path]
    """A mesh file, which is photographed from 40 sides;
    or a folder with posed images (transforms.json, COLMAP, or of another program in docs/captures.md)."""
    out: Path
    """Folder for the results: mesh.ply, mesh.obj, mesh.glb, metrics.json, report.html and more."""
    settings: Annotated[ReconstructConfig, tyro.conf.arg(name="")]
    init_mesh: Annotated[Path | None, Rare] = None
    """Start from this mesh; in the units of the source."""
    masks: Annotated[Path | None, Rare] = None
    """Folder with a mask (white inside the object) for every image; else masks/ of the source, or transparency."""
    depths: Annotated[Path | None, Rare] = None
    """Folder with depth maps of images (16-bit PNG, NPY, EXR), distances along the optical axis, 0 where unknown;
    else depths/ or depth/ of the source, or what its transforms.json names."""
    depth_unit: Annotated[float | None, Rare] = None
    """Units of the source in a step of their numbers; else what transforms.json says, 0.001 for integers, or 1."""


@dataclass(frozen=True, kw_only=True)
class SceneCommand(RunCommand):
    """Base of the commands that fit a soup, which can be watched meanwhile."""

    view: Annotated[Flag, Rare] = False
    """Serve the soup for a web browser while it is trained (needs the extra "viewer")."""
    view_port: Annotated[int, Rare] = 8080
    """Port to serve it on, at localhost; the next free one if it is in use."""

    def onlooker(self) -> "LiveView | None":
        """A viewer of the soup in memory, if it is asked for."""
        if not 0 <= self.view_port <= 65535:
            raise InputError(f"view-port: is {self.view_port}; it must be between 0 and 65535")
        if not self.view:
            return None
        from etsplat.viewer.live import LiveView

        def announce(port: int) -> None:
            print(f"  watch it at http://localhost:{port}", flush=True)

        return LiveView(self.out, "localhost", self.view_port, VIEW_WIDTH, announce)


@dataclass(frozen=True, kw_only=True)
class Train(SceneCommand):
    """Fit a triangle soup to the photos of a scene.

    Examples:
        etsplat train my_scene/ --out runs/scene
        etsplat train my_scene/ --out runs/scene --scene-type indoor --width 1000 --iterations 8000
        etsplat train my_scene/ --out runs/scene --preset paper --images images_4
        etsplat train my_scene/ --out runs/scene --view
        etsplat train my_city/ --out runs/city --blocks 3x2 --max-triangles 2000000
        etsplat train my_scene/ --out runs/again --config runs/scene/config.json --finish opaque
    """

    CONFIG = TrainConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "quick", "scene_type": "outdoor"}
    INPUT = ("images", "masks", "depths", "depth_unit", "init_points", "blocks")
    PREPARING = "Reading the photos"

    source: tyro.conf.Positional[Path]
    """A folder with posed photos: COLMAP, nerfstudio, Blender; or of another program in docs/captures.md.
    For photos alone: `etsplat data sfm`."""
    out: Path
    """Folder for the results: soup.safetensors, metrics.json, report.html and more."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    images: Annotated[str | None, Rare] = None
    """Folder in the scene to take the photos from, such as images_4."""
    masks: Annotated[Path | None, Rare] = None
    """Folder with a mask for every photo, white where pixels count."""
    depths: Annotated[Path | None, Rare] = None
    """Folder with depth maps of photos (16-bit PNG, NPY, EXR), distances along the optical axis, 0 where unknown;
    else depths/ or depth/ of the scene, or what its transforms.json names."""
    depth_unit: Annotated[float | None, Rare] = None
    """Units of the scene in a step of their numbers; else what transforms.json says, 0.001 for integers, or 1."""
    init_points: Annotated[Path | None, Rare] = None
    """Start from this dense cloud (PLY or LAS), in the units of the scene, as far as photos speak for it."""
    blocks: Annotated[str | None, Rare] = None
    """Cut the scene into columns and rows of blocks, as 3x2, or auto, and train one after the other:
    for scenes larger than memory. Settings are those of each block (docs/blocks.md)."""
    tensorboard: Annotated[Flag, Rare] = False
    """Write curves for tensorboard into the folder as well."""

    def callbacks(self) -> "list[Callback]":
        """Tensorboard's, if it is asked for."""
        if not self.tensorboard:
            return []
        from etsplat.cli.tensorboard import TensorboardWriter

        return [TensorboardWriter(self.out)]


@dataclass(frozen=True, kw_only=True)
class DemoScene(SceneCommand):
    """Fit a triangle soup to pictures of a small scene that is built in code: no photos needed.

    Examples:
        etsplat demo scene
        etsplat demo scene --out scene --method single-sided
    """

    CONFIG = TrainConfig
    PRESET: ClassVar[dict[str, str]] = {"preset": "demo", "scene_type": "outdoor"}
    SOURCE = "demo:scene"

    out: Path = Path("runs/demo_scene")
    """Folder for the results."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
