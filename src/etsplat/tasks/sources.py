"""What runs are of, a mesh, which is photographed, or photos; what they start from; and soups to go on with.

A `SoupRun` is what every command that comes after training starts from.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from operator import getitem
from pathlib import Path
from typing import Any

import torch

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.demo_scene import HEIGHT, WIDTH, demo_scene
from etsplat.data.dense_cloud import FEWEST_POINTS, dense_start
from etsplat.data.frame_gaps import without_frame_gaps
from etsplat.data.hull import bounding_sphere, check_not_empty
from etsplat.data.load import load_dataset
from etsplat.data.photograph import normalize_mesh, photograph
from etsplat.data.silhouettes import contradicting, looks_inverted
from etsplat.engines.choice import resolve_device
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.opaque_files import load_opaque
from etsplat.io.paths import given_path, path_remedy
from etsplat.io.photos import file_remedy
from etsplat.io.point_clouds import load_cloud
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_import import open_soup
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.demos import DEMO_OBJECT, DEMO_SCENE, check_demo
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.refined_cameras import alignment_starts, kept_aside, refined_capture
from etsplat.tasks.settings import Settings, settings_of
from etsplat.tasks.train_config import TrainConfig

Source = str | Path | MeshFile | Dataset


_NEAR, _SMALL, _LARGE = 0.5, 0.25, 2.0
"""How far from the origin the sphere around an object may be, and its radius, where a data set has it in the unit
sphere; the sphere is a rough one."""

_A_FOLDER = "a folder with posed images, and a mesh, a Dataset and a demo have none"


def straight_alpha(capture: Dataset) -> list[str]:
    """A sentence about photos that are not premultiplied, though they are to be; none where all are."""
    if not (straight := capture.images.straight):
        return []
    some = ", ".join(capture.names[index] for index in straight[:3]) + (", ..." if len(straight) > 3 else "")
    return [f"colours above their alpha in {some}: photos with alpha must be premultiplied, rgb * alpha"]


def load_source(
    source: Source,
    config: ReconstructConfig,
    masks: str | Path | None = None,
    *,
    depths: bool | Path | str = False,
    depth_unit: float | None = None,
) -> tuple[MeshFile | Dataset, Sequence[str]]:
    """Reads a mesh file or a scene folder, or makes the demo's object; objects are passed through.

    Of a folder, views are left out whose masks contradict the others', and photos are cropped where their mask
    ends just before the frame that cuts the object off.

    Args:
        source: what to read.
        config: the resolution of a scene's images.
        masks: folder with a mask for every image of a scene folder, instead of the scene's own.
        depths: as of `load_dataset`.
        depth_unit: likewise.

    Returns:
        What is to be reconstructed, and notes about what of it is not used.

    Raises:
        InputError: there is nothing at the path, or what is there cannot be used; masks for something else than a
            scene folder.
        ValueError: the arrays of a mesh are no such arrays.
    """
    if not isinstance(source, MeshFile | Dataset):
        given_path("source", source, "a path, a demo's name, a MeshFile or a Dataset")
    for name, folder in (("masks", masks), ("depths", None if isinstance(depths, bool) else depths)):
        if folder is not None and (isinstance(source, MeshFile | Dataset) or not Path(source).is_dir()):
            raise InputError(f"{name} {folder}: belong to {_A_FOLDER}; leave them out")
    if isinstance(source, MeshFile):
        source.check()
        return source, source.notes
    if isinstance(source, Dataset):
        scene, notes = _in_unit_sphere(source)
        return scene, [*notes, *straight_alpha(source)]
    check_demo(source, "reconstruct")
    if str(source) == DEMO_OBJECT:
        return demo_object(), []
    path = Path(source)
    if path.is_dir():
        loaded = load_dataset(
            path, masks_as="alpha", width=config.resolution, masks=masks, depths=depths, depth_unit=depth_unit
        )
        scene, notes = _agreeing(loaded)
        return scene.renormalized(*bounding_sphere(scene)), [*scene.notes, *notes]
    if remedy := file_remedy(path):
        raise InputError(f"{path}: {remedy}")
    if path.is_file():
        mesh = load_mesh(path)
        return mesh, mesh.notes
    raise InputError(f"{path}: no such file or folder; {path_remedy(path)}")


def _in_unit_sphere(scene: Dataset) -> tuple[Dataset, list[str]]:
    """A data set as it is where its object is in the unit sphere, or else moved there, which a note says."""
    if scene.normalization.radius != 1 or bool(scene.normalization.center.any()):  # somebody has moved it
        return scene, []
    try:
        center, radius = bounding_sphere(scene)
    except InputError:  # no outlines: it starts from a sphere about the origin
        return scene, []
    if float(center.norm()) <= _NEAR and radius <= _LARGE and radius >= _SMALL:
        return scene, []
    x, y, z = center.tolist()
    where = f"the object is about ({x:.3g}, {y:.3g}, {z:.3g}), in a sphere of radius {radius:.3g}"
    return scene.renormalized(center, radius), [f"{where}: moved into the unit sphere; results are in the units given"]


def _agreeing(scene: Dataset) -> tuple[Dataset, list[str]]:
    """Without views whose masks contradict the others', nor gaps at frames; and notes that name the photos."""
    scene, cropped = without_frame_gaps(scene)
    notes = []
    if cropped:
        names = ", ".join(scene.names[index] for index in cropped)
        notes.append(f"cropped, since a mask ends along the frame just before it: {names}")
    if looks_inverted(scene):
        notes.append("masks are white along the border of most photos: they are to be white inside the object alone")
    check_not_empty(scene, scene.test)  # of training views `bounding_sphere` does
    wrong = contradicting(scene)
    if wrong:
        names = ", ".join(scene.names[index] for index in sorted(wrong))
        contradict = "its mask contradicts" if len(wrong) == 1 else "their masks contradict"
        notes.append(f"left out, since {contradict} the others: {names}")
        train, test = ([index for index in some if index not in wrong] for some in (scene.train, scene.test))
        scene = replace(scene, train=train, test=test)
    return scene, notes


def load_scene(
    source: str | Path | Dataset,
    width: int | None,
    images: str | None = None,
    masks: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    depths: bool | Path | str = False,
    depth_unit: float | None = None,
    preload: bool = True,
    memory: int | None = None,
) -> Dataset:
    """Reads a scene's folder as `load_dataset` does, or makes the demo's scene in photos no wider than its own.

    Args:
        source: what to read; a data set is passed through.
        width: wider photos are scaled down to this; None for the usual limit.
        images: folder in the scene to take the photos from.
        masks: folder with a mask for every photo.
        progress: called with (views done, views in all).
        depths: as of `load_dataset`.
        depth_unit: likewise.
        preload: decode all photos now.
        memory: as of `load_dataset`.

    Raises:
        InputError: what is there cannot be used; a folder of pictures for something else than a scene folder.
    """
    folders = {"images": images, "masks": masks, "depths": None if isinstance(depths, bool) else depths}
    for name, folder in folders.items():
        if folder is not None and (isinstance(source, Dataset) or str(source) == DEMO_SCENE):
            raise InputError(f"{name} {folder}: belong to {_A_FOLDER}; leave them out")
    if isinstance(source, Dataset):
        return source
    given_path("source", source, "a path, a demo's name or a Dataset")
    check_demo(source, "train")
    if str(source) == DEMO_SCENE:
        width = min(WIDTH, width or WIDTH)
        return demo_scene(width, max(1, round(HEIGHT * width / WIDTH)), progress=progress)
    return load_dataset(
        source,
        images=images,
        width=width,
        masks=masks,
        depths=depths,
        depth_unit=depth_unit,
        progress=progress,
        preload=preload,
        memory=memory,
    )


def with_cloud(
    scene: Dataset, path: str | Path, most: int, progress: Callable[[int, int], None] | None = None
) -> tuple[Dataset, str]:
    """A scene with the points of a dense cloud that its photos speak for, in the place of its own; and a note.

    Args:
        scene: in its own units.
        path: of the cloud, in the same units; in the world's, where a georeference says how the scene lies in that.
        most: triangles that there may be; half as many points are taken, or as many as the scene has of its own.
        progress: called with (photos compared, photos in all).

    Raises:
        InputError: as `load_cloud`; or photos speak for fewer than 100 points.
    """
    points, colors = load_cloud(path)
    if scene.georeference is not None:
        far = scene.georeference
        points = (points - torch.tensor(far.offset, dtype=torch.float64)) / far.scale
    replaced = 0 if scene.exact_points is None else len(scene.exact_points)
    found = dense_start(points, colors, scene, max(1, most // 2, replaced), progress)
    if len(found.positions) < FEWEST_POINTS:
        raise InputError(
            f"points {path}: {found.note}; they must be in the frame and units of the photos' poses: align them first"
        )
    return replace(scene, exact_points=found.positions, point_colors=found.colors), f"points {path}: {found.note}"


def make_subject(
    source: MeshFile | Dataset,
    config: ReconstructConfig,
    progress: Callable[[int, int], None],
    device: torch.device,
) -> tuple[Dataset, MeshFile | None]:
    """Photographs a mesh; views are ready as they are (loaders put the object into the unit sphere).

    Args:
        source: from `load_source`.
        config: resolution and supersampling; how many photos are kept from training to watch the run by.
        progress: called with (views done, views in all) while photographing.
        device: where a mesh is photographed.

    Returns:
        Images and cameras in the frame where the object fills the unit sphere around the origin (`normalization` leads
        back to the input's units); and the mesh that was photographed, in that frame, or None if there is none.

    Raises:
        InputError: the mesh has no extent, or there are no views to train on.
    """
    if isinstance(source, MeshFile):
        side, samples = config.resolution, config.pictures.supersampling
        views = photograph(source, side, side, supersampling=samples, progress=progress, device=device)
        # There is the mesh itself to compare with, so photos are kept only where that is asked for.
        kept = views if (config.watch, config.refine_cameras) == (None, "off") else _kept(views, config)
        return kept, normalize_mesh(source)[0]
    if not source.train:
        raise InputError("views: none to train on; name some in `train`")
    return _kept(source, config), None


def _kept(views: Dataset, config: ReconstructConfig) -> Dataset:
    return kept_aside(views, config.watch, config.refine_cameras)


def fingerprint(source: MeshFile | Dataset | None) -> str | None:
    """A short hash of everything in a source that a run depends on."""
    if source is None:
        return None
    if isinstance(source, Dataset):
        return source.fingerprint()
    digest = hashlib.sha256()
    textures = () if source.texture is None else vars(source.texture).values()
    for tensor in (source.vertices, source.faces, source.face_colors, source.vertex_colors, *textures):
        if tensor is not None:
            digest.update(str(tuple(tensor.shape)).encode())
            digest.update(tensor.contiguous().cpu().numpy().data)
    return digest.hexdigest()[:16]


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
    """

    path: Path
    soup: TriangleSoup
    capture: Dataset | None
    opaque: MeshFile | None = None
    test_cameras: Mapping[int, Cameras] = field(default_factory=dict)
    engine: str | None = None
    in_blocks: bool = False
    gone: str | None = None

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
            raise InputError(f"{self.path}: its scene {self.gone} has gone; name where it is now with --scene")
        if self.capture is None:
            why = "a file does not say which scene it shows"
            if is_run(self.path):
                why = "the scene of this run is in no folder: it was a Dataset in memory, or has moved"
            raise InputError(f"{self.path}: {why}; name the scene's folder with --scene")
        return self.capture


def open_run(
    path: Path | str,
    scene: Dataset | Path | str | None = None,
    device: str | None = None,
    engine: str | None = None,
) -> SoupRun:
    """Open the run directory of `etsplat train`, or any file that `etsplat.model.soup_import.open_soup` reads.

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
    return SoupRun(path, open_soup(path).to(place), capture_at(scene), engine=engine)


def capture_at(scene: Dataset | Path | str | None) -> Dataset | None:
    """A capture by its folder, or as it is; photos of a folder are decoded when they are asked for."""
    return scene if scene is None or isinstance(scene, Dataset) else load_dataset(scene, preload=False)


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
        raise InputError(f"{path}: is not a run of etsplat; name a folder that was given to --out, or a soup's file")
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
    capture = refined_capture(given, path)
    return replace(opened, capture=capture, test_cameras={} if capture is given else alignment_starts(given, capture))
