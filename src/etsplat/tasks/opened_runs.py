"""Runs and files of soups to go on with: what every command that comes after training starts from."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from operator import getitem
from pathlib import Path
from typing import Any

import torch

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.spelling import either, option
from etsplat.data.dataset import Dataset
from etsplat.engines.choice import resolve_device
from etsplat.io.mesh_files import MeshFile
from etsplat.io.opaque_files import load_opaque
from etsplat.io.paths import path_remedy
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_import import load_soup
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.demos import DEMO_SCENE
from etsplat.tasks.refined_cameras import alignment_starts, refined_capture
from etsplat.tasks.settings import Settings, settings_of
from etsplat.tasks.sources import load_scene, views_digest
from etsplat.tasks.train_config import TrainConfig


@dataclass(frozen=True)
class SoupRun:
    """A soup and, where it is known, its capture; both in the capture's own units.

    Attributes:
        path: what was opened: a run directory or a file.
        soup: the triangles.
        capture: cameras and photos; images are decoded when they are asked for. None where it is not known.
        opaque: the opaque mesh that the run made beside the soup, on the CPU; None if it made none.
        test_cameras: of a run that refined cameras, those of test views, by their index, from which they are aligned.
        engine: that draws videos, pictures and what the viewer shows; None for the one of the soup's device.
        in_blocks: whether it was trained in blocks, of which no opaque mesh is made.
        gone: the folder of its scene, where that is not there any more.
        other_scene: whether the capture is known to be another one than that of the training.
        notes: a sentence for each thing of a file that is otherwise in the soup.
    """

    path: Path
    soup: TriangleSoup
    capture: Dataset | None
    opaque: MeshFile | None = None
    test_cameras: Mapping[int, Cameras] = field(default_factory=dict)
    engine: str | None = None
    in_blocks: bool = False
    gone: str | None = None
    other_scene: bool = False
    notes: tuple[str, ...] = ()

    @property
    def device(self) -> torch.device:
        """Where the soup is, and pictures of it are drawn."""
        return self.soup.vertices.device

    @cached_property
    def solid(self) -> SolidSoup | None:
        """The faces of the opaque mesh in the place of the soup, on its device; None if the run made none."""
        return None if self.opaque is None else SolidSoup.of(self.opaque, self.soup)

    @property
    def folder(self) -> Path:
        """Where results go unless told otherwise: the run directory, or the folder of the file."""
        return self.path if self.path.is_dir() else self.path.parent

    def needed_capture(self) -> Dataset:
        """The capture.

        Raises:
            InputError: it is not known.
        """
        if self.gone is not None:
            now = f"name where it is now with {option('scene', ...)}"
            raise InputError(f"{self.path}: its scene {self.gone} has gone; {now}")
        if self.capture is None:
            why = "a file does not say which scene it shows"
            if is_run(self.path):
                why = "the scene of this run is in no folder: it was a Dataset in memory, or has moved"
            raise InputError(f"{self.path}: {why}; name the scene's folder with {option('scene', ...)}")
        return self.capture


def open_run(
    path: Path | str,
    scene: Dataset | Path | str | None = None,
    device: str | None = None,
    engine: str | None = None,
) -> SoupRun:
    """Open the run directory of `etsplat train`, or any file that `etsplat.model.soup_import.load_soup` reads.

    Args:
        path: of the run or the file.
        scene: the capture or its folder, where it has moved or is not known.
        device: of the soup, and so of what is drawn of it: "cpu", "cuda", or None for cuda where there is a GPU.
        engine: that draws what is rendered and viewed, by its name; None for the one of the device.

    Raises:
        EngineUnavailableError: `device` or `engine` asks for a GPU, and something is missing.
        InputError: nothing there, neither a run with a soup nor a readable file. A capture that has gone is an error
            only where it is needed.
    """
    path, place = Path(path), resolve_device(device, engine)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; {path_remedy(path)}")
    if path.is_dir():
        return replace(_open_directory(path, scene, place), engine=engine)
    notes: list[str] = []
    soup = load_soup(path, notes.append).to(place)
    return SoupRun(path, soup, capture_at(scene), engine=engine, notes=tuple(notes))


def capture_at(scene: Dataset | Path | str | None) -> Dataset | None:
    """A capture by its folder or as the demo's, or as it is; photos of a folder are decoded when they are asked for."""
    return None if scene is None else load_scene(scene, None, preload=False)


def check_not_read(path: Path, source: Path, named: str = "") -> None:
    """Sees to it that a file to write is none of those from which it is made, which it would replace.

    Args:
        path: of the file to write.
        source: a run directory, or a file.
        named: before the path in the message.

    Raises:
        InputError: it is.
    """
    run = RunDirectory(source)
    read = (run.soup_path, run.opaque_path, run.mesh_path(".ply")) if source.is_dir() else (source,)
    if path.resolve() in [file.resolve() for file in read]:
        raise InputError(f"{named}{path}: is what is read; choose another file")


def check_trains(run: Path) -> None:
    """Sees to it that a run is one that has a soup, or will have.

    Raises:
        InputError: it is another kind of run.
    """
    task = RunDirectory(run).read_config()["task"]
    if task == "reconstruct":
        raise InputError(
            f"{run}: is a run of `etsplat reconstruct`: its mesh.glb opens in any mesh viewer, its report.html has the "
            "numbers; name a run of `etsplat train`"
        )
    if task != "train":
        raise InputError(f"{run}: is no run of `etsplat train`; name another")


def read_record(run: RunDirectory, kind: type[Settings], names: Iterable[str], *needed: str) -> dict[str, Any]:
    """A run's config.json, from which only some settings are used: so it may be of a version that had other ones.

    Args:
        run: of `kind`.
        kind: declares the settings.
        names: of the settings that are used; they must be there, with values that they may have.
        needed: what else config.json must have, as of `RunDirectory.read_config`.

    Raises:
        InputError: it has not.
    """
    names = tuple(names)
    record = run.read_config(*needed, "config", *(f"config.{name}" for name in names))
    try:
        for name in names:
            settings_of(kind)[name].check(name, reduce(getitem, name.split("."), record["config"]))
    except InputError as error:
        raise InputError(f"{run.config_path}: {error}") from error
    return record


def training_cameras(capture: Dataset) -> list[Cameras]:
    """The single cameras of the training views."""
    cameras = capture.cameras
    return [cameras[index] for index in capture.train]


def _open_directory(path: Path, scene: Dataset | Path | str | None, device: torch.device) -> SoupRun:
    if not is_run(path):
        a_run = either("a folder that was given to --out", "the folder of one")
        raise InputError(f"{path}: is not a run of etsplat; name {a_run}, or a soup's file")
    check_trains(path)
    run = RunDirectory(path)
    if not run.soup_path.is_file():
        raise InputError(
            f"{path}: has no {run.soup_path.name} (yet); name a run of `etsplat train` that got to a checkpoint"
        )
    soup = TriangleSoup.load(run.soup_path).to(device)
    config = read_record(run, TrainConfig, ["width"], "paths.source")
    paths, width = config["paths"], config["config"]["width"]
    source = paths["source"] if scene is None else scene
    opaque = load_opaque(run.opaque_path) if run.opaque_path.is_file() else None
    opened = SoupRun(path, soup, None, opaque, in_blocks=paths.get("blocks") is not None)
    if source is None:
        return opened
    if isinstance(source, Dataset):
        given = source
    elif scene is None and source != DEMO_SCENE and not Path(source).is_dir():
        return replace(opened, gone=source)
    else:
        given = load_scene(source, width, paths.get("images"), paths.get("masks"), preload=False)
    known = config.get("views")
    opened = replace(opened, other_scene=scene is not None and known is not None and known != views_digest(given))
    capture = refined_capture(given, path)
    return replace(opened, capture=capture, test_cameras={} if capture is given else alignment_starts(given, capture))
