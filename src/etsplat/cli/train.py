"""`etsplat train` and `etsplat demo scene`: novel-view synthesis with a progress bar and a report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from etsplat.cli.command import Command, Flag, option_value
from etsplat.cli.running import run_task
from etsplat.tasks.train_config import PRESET_NAMES, SCENE_TYPE_NAMES, TrainConfig, train_settings

if TYPE_CHECKING:
    from etsplat.cli.progress import RunProgress

Settings = Annotated[TrainConfig, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


def _settings_of(arguments: Sequence[str], preset: str) -> TrainConfig:
    """The settings that `--preset` and `--scene-type` name: the defaults of all other options depend on them."""
    chosen = option_value(arguments, "--preset")
    scene_type = option_value(arguments, "--scene-type")
    return train_settings(  # tyro refuses an unknown name
        chosen if chosen in PRESET_NAMES else preset, scene_type if scene_type in SCENE_TYPE_NAMES else "outdoor"
    )


@dataclass(frozen=True, kw_only=True)
class Train(Command):
    """Fit a triangle soup to the photos of a scene."""

    EXAMPLES: ClassVar[str] = """
    etsplat train my_scene/ --out runs/scene
    etsplat train my_scene/ --out runs/scene --scene-type indoor --width 1000 --iterations 8000
    etsplat train my_scene/ --out runs/scene --preset paper --images images_4
    etsplat train my_scene/ --out runs/scene --finish opaque
    """

    source: tyro.conf.Positional[Path]
    """A folder with posed photos: COLMAP, nerfstudio or Blender. For photos alone: `etsplat data sfm`."""
    out: Path
    """Folder for the results: soup.safetensors, metrics.json, report.html and more."""
    settings: Settings
    images: str | None = None
    """Folder in the scene to take the photos from, such as images_4."""
    masks: Path | None = None
    """Folder with a mask for every photo, white where pixels count."""
    tensorboard: Flag = False
    """Write curves for tensorboard into the folder as well."""
    overwrite: Flag = False
    """Replace an earlier run in the folder."""
    resume: Flag = False
    """Continue an interrupted run in the folder; give the same options as then."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Train":
        """The settings of the preset and the kind of scene."""
        return cls(source=tyro.MISSING, out=tyro.MISSING, settings=_settings_of(arguments, "quick"))

    def run(self, arguments: Sequence[str]) -> int:
        """Trains on the scene."""
        return _run(self.source, self, arguments)


@dataclass(frozen=True, kw_only=True)
class DemoScene(Command):
    """Fit a triangle soup to pictures of a small scene that is built in code: no photos needed."""

    EXAMPLES: ClassVar[str] = """
    etsplat demo scene
    etsplat demo scene --out scene --method single-sided
    """

    what: tyro.conf.Positional[Literal["scene"]]
    """The built-in scene; `etsplat demo` alone reconstructs an object."""
    settings: Settings
    out: Path = Path("runs/demo_scene")
    """Folder for the results."""
    overwrite: Flag = False
    """Replace an earlier run in the folder."""
    resume: Flag = False
    """Continue an interrupted run in the folder."""
    images: ClassVar[None] = None
    masks: ClassVar[None] = None
    tensorboard: ClassVar[bool] = False

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "DemoScene":
        """The preset's settings."""
        return cls(what="scene", settings=_settings_of(arguments, "demo"))

    def run(self, arguments: Sequence[str]) -> int:
        """Trains on the built-in scene."""
        return _run("demo:scene", self, arguments)


def _run(source: Path | str, command: Train | DemoScene, arguments: Sequence[str]) -> int:
    from etsplat.tasks.running import Callback
    from etsplat.tasks.train import train

    callbacks: list[Callback] = []
    if command.tensorboard:
        from etsplat.cli.tensorboard import TensorboardWriter

        callbacks.append(TensorboardWriter(command.out))

    def task(progress: "RunProgress") -> None:
        train(
            source,
            command.out,
            command.settings,
            images=command.images,
            masks=command.masks,
            callbacks=[progress, *callbacks],
            resume=command.resume,
            overwrite=command.overwrite,
        )

    return run_task(task, command.out, arguments, debug=command.debug, preparing="Reading the photos")
