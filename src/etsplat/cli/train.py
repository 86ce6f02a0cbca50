"""`etsplat train` and `etsplat demo scene`: novel-view synthesis with a progress bar and a report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from etsplat.cli.command import Flag, settings_before_options
from etsplat.cli.running import RunCommand
from etsplat.tasks.settings import Rare
from etsplat.tasks.train_config import TrainConfig

if TYPE_CHECKING:
    from etsplat.cli.progress import RunProgress
    from etsplat.tasks.running import Callback

Settings = Annotated[TrainConfig, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Train(RunCommand):
    """Fit a triangle soup to the photos of a scene."""

    EXAMPLES: ClassVar[str] = """
    etsplat train my_scene/ --out runs/scene
    etsplat train my_scene/ --out runs/scene --scene-type indoor --width 1000 --iterations 8000
    etsplat train my_scene/ --out runs/scene --preset paper --images images_4
    etsplat train my_scene/ --out runs/again --config runs/scene/config.json --finish opaque
    """
    PREPARING: ClassVar[str] = "Reading the photos"

    source: tyro.conf.Positional[Path]
    """A folder with posed photos: COLMAP, nerfstudio or Blender. For photos alone: `etsplat data sfm`."""
    out: Path
    """Folder for the results: soup.safetensors, metrics.json, report.html and more."""
    settings: Settings
    images: Annotated[str | None, Rare] = None
    """Folder in the scene to take the photos from, such as images_4."""
    masks: Annotated[Path | None, Rare] = None
    """Folder with a mask for every photo, white where pixels count."""
    tensorboard: Annotated[Flag, Rare] = False
    """Write curves for tensorboard into the folder as well."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Train":
        """The settings of the preset and the kind of scene."""
        settings = settings_before_options(TrainConfig, arguments, preset="quick", scene_type="outdoor")
        return cls(source=tyro.MISSING, out=tyro.MISSING, settings=settings)

    def task(self, progress: "RunProgress") -> None:
        """Trains on the scene."""
        from etsplat.tasks.train import train

        callbacks: list[Callback] = [progress]
        if self.tensorboard:
            from etsplat.cli.tensorboard import TensorboardWriter

            callbacks.append(TensorboardWriter(self.out))
        train(
            self.source,
            self.out,
            self.settings,
            images=self.images,
            masks=self.masks,
            callbacks=callbacks,
            **self.place,
        )


@dataclass(frozen=True, kw_only=True)
class DemoScene(RunCommand):
    """Fit a triangle soup to pictures of a small scene that is built in code: no photos needed."""

    EXAMPLES: ClassVar[str] = """
    etsplat demo scene
    etsplat demo scene --out scene --method single-sided
    """
    PREPARING: ClassVar[str] = "Taking pictures"

    out: Path = Path("runs/demo_scene")
    """Folder for the results."""
    settings: Settings

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "DemoScene":
        """The preset's settings."""
        return cls(settings=settings_before_options(TrainConfig, arguments, preset="demo", scene_type="outdoor"))

    def task(self, progress: "RunProgress") -> None:
        """Trains on the built-in scene."""
        from etsplat.tasks.train import train

        train("demo:scene", self.out, self.settings, callbacks=[progress], **self.place)
