"""A trained soup with the capture it was trained on: what every command that comes after training starts from."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.load import load_dataset
from etsplat.engines.choice import resolve_device
from etsplat.io.paths import path_remedy
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.model.soup_import import open_soup
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.sources import DEMO_SCENE, load_scene


@dataclass(frozen=True)
class SoupRun:
    """A soup and, where it is known, its capture; both in the capture's own units.

    Attributes:
        path: what was opened: a run directory or a file.
        soup: the triangles.
        capture: cameras and photos; images are decoded when they are asked for. None for a file without its scene.
    """

    path: Path
    soup: TriangleSoup
    capture: Dataset | None

    @property
    def device(self) -> torch.device:
        """Where the soup is, and pictures of it are drawn."""
        return self.soup.vertices.device

    @property
    def folder(self) -> Path:
        """Where results go unless told otherwise: the run directory, or the folder of the file."""
        return self.path if self.path.is_dir() else self.path.parent

    def needed_capture(self) -> Dataset:
        """The capture.

        Raises:
            InputError: it is not known.
        """
        if self.capture is None:
            raise InputError(f"{self.path}: a file does not say which scene it shows; name the scene with --scene")
        return self.capture


def open_run(path: Path | str, scene: Path | str | None = None, device: str | None = None) -> SoupRun:
    """Open the run directory of `etsplat train`, or any file that `etsplat.model.soup_import.open_soup` reads.

    Args:
        path: of the run or the file.
        scene: the capture's folder, where it has moved or is not known.
        device: of the soup, and so of what is drawn of it: "cpu", "cuda", or None for cuda where there is a GPU.

    Raises:
        EngineUnavailableError: `device` asks for a GPU, and something is missing.
        InputError: nothing there, neither a run with a soup nor a readable file; the capture has gone.
    """
    path, place = Path(path), resolve_device(device, None)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; {path_remedy(path)}")
    if path.is_dir():
        return _open_directory(path, scene, place)
    return SoupRun(path, open_soup(path).to(place), None if scene is None else load_dataset(scene, preload=False))


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


def world_up(viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "3"] | None:
    """Where up is in the world: the mean of the cameras' own up directions; None if they contradict each other."""
    up = -viewmats[:, 1, :3].double().mean(dim=0)
    length = float(up.norm())
    return up / length if length > 0.3 else None


def training_cameras(capture: Dataset) -> list[Cameras]:
    """The single cameras of the training views."""
    cameras = capture.cameras
    return [cameras[index] for index in capture.train]


def _open_directory(path: Path, scene: Path | str | None, device: torch.device) -> SoupRun:
    if not is_run(path):
        raise InputError(f"{path}: is not a run of etsplat; name a folder that was given to --out, or a soup's file")
    check_trains(path)
    run = RunDirectory(path)
    if not run.soup_path.is_file():
        raise InputError(
            f"{path}: has no {run.soup_path.name} (yet); name a run of `etsplat train` that got to a checkpoint"
        )
    soup = TriangleSoup.load(run.soup_path).to(device)
    config = run.read_config()
    paths = config["paths"]
    source = scene or paths["source"]
    if source is None:
        return SoupRun(path, soup, None)
    if scene is None and source != DEMO_SCENE and not Path(source).is_dir():
        raise InputError(f"{path}: its scene {source} has gone; name where it is now with --scene")
    width = config["config"]["width"]
    return SoupRun(path, soup, load_scene(source, width, paths.get("images"), paths.get("masks"), preload=False))


def rotation_to_y_up(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes the unit vector `up` to +y, float64."""
    target = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    axis, cosine = torch.linalg.cross(up.double(), target), float(up.double() @ target)
    if cosine < -1 + 1e-9:  # upside down: half a turn about x
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    x, y, z = axis.tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + skew + skew @ skew / (1 + cosine)
