"""What runs are of: a mesh, which is photographed, or photos; and what they start from."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.close_ups import close_ups, cropped_to
from etsplat.data.dataset import Dataset
from etsplat.data.dataset_checks import check_training_views
from etsplat.data.demo_object import demo_object
from etsplat.data.demo_scene import HEIGHT, WIDTH, demo_scene
from etsplat.data.dense_cloud import FEWEST_POINTS, dense_start
from etsplat.data.doubtful_poses import doubts, with_doubts
from etsplat.data.far_vertices import far_vertices_note
from etsplat.data.frame_gaps import without_frame_gaps
from etsplat.data.hull import bounding_sphere, check_not_empty
from etsplat.data.load import load_dataset
from etsplat.data.photograph import normalize_mesh, photograph
from etsplat.data.silhouettes import contradicting, looks_inverted
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.paths import given_path, path_remedy
from etsplat.io.photos import file_remedy
from etsplat.io.point_clouds import load_cloud
from etsplat.tasks.demos import DEMO_OBJECT, DEMO_SCENE, check_demo
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.refined_cameras import kept_aside

Source = str | Path | MeshFile | Dataset


_NEAR, _SMALL, _LARGE = 0.5, 0.25, 2.0
"""How far from the origin the sphere around an object may be, and its radius, where a data set has it in the unit
sphere; the sphere is a rough one."""

_A_FOLDER = "a folder with posed images, and a mesh, a Dataset and a demo have none"


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
    ends just before the frame that cuts the object off. Photos in which the object is small are cropped to it, and
    those of a folder are read larger first, so that a close-up is as wide as photos are to be; not where their cameras
    are refined, which are those of whole photos.

    Args:
        source: what to read.
        config: the resolution of a scene's images; whether cameras are refined.
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
        return source, _notes(source)
    if isinstance(source, Dataset):
        check_training_views(source.train)
        close, found = (source, []) if config.refine_cameras != "off" else _closer(source, lambda width: source)
        scene, notes = _in_unit_sphere(close)
        return scene, [*found, *notes, *doubts(source)]
    check_demo(source, "reconstruct")
    if str(source) == DEMO_OBJECT:
        return demo_object(), []
    path = Path(source)
    if path.is_dir():
        read = partial(load_dataset, path, masks_as="alpha", masks=masks, depths=depths, depth_unit=depth_unit)
        loaded, close = read(width=config.resolution), list[str]()
        if config.refine_cameras == "off":
            # What is read to be cropped is let go of again.
            loaded, close = _closer(loaded, partial(read, memory=0, preload=False))
        scene, notes = _agreeing(loaded)
        return scene.renormalized(*bounding_sphere(scene)), [*scene.notes, *close, *notes]
    if remedy := file_remedy(path):
        raise InputError(f"{path}: {remedy}")
    if path.is_file():
        mesh = load_mesh(path)
        return mesh, _notes(mesh)
    raise InputError(f"{path}: no such file or folder; {path_remedy(path)}")


def _notes(mesh: MeshFile) -> list[str]:
    far = far_vertices_note(mesh)
    return [*mesh.notes, *([] if far is None else [far])]


def _closer(scene: Dataset, read: Callable[..., Dataset]) -> tuple[Dataset, list[str]]:
    """Photos cropped to the object, where it is small in them, which a note says.

    Args:
        scene: photos with alpha.
        read: the same with photos of another `width`.
    """
    boxes = close_ups(scene)
    if boxes is None:
        return scene, []
    sizes = scene.images.sizes
    shares = [(box.right - box.left) / width for box, (width, _) in zip(boxes, sizes, strict=True)]
    width = max(width for width, _ in sizes)
    wider = read(width=round(width / sorted(shares)[len(shares) // 2]))
    found = cropped_to(wider, boxes, sizes)
    return found, ["the object is small in the photos: they are cropped to it"]


def _in_unit_sphere(scene: Dataset) -> tuple[Dataset, list[str]]:
    """A data set as it is where its object is in the unit sphere, or else moved there, which a note says."""
    if scene.normalization.radius != 1 or bool(scene.normalization.center.any()):  # somebody has moved it
        return scene, []
    if not scene.has_masks:  # it starts from a sphere about the origin
        return scene, []
    center, radius = bounding_sphere(scene)
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
        contradict = "its mask or pose contradicts" if len(wrong) == 1 else "their masks or poses contradict"
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
        check_training_views(source.train)
        return with_doubts(source)
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
    points, colors = load_cloud(given_path("init_points", path))
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


def views_digest(views: Dataset) -> str:
    """A short hash of what photos are called and where they were taken from, whatever becomes of them in a run."""
    return _named_digest(views, views.viewmats)


def directions_digest(views: Dataset) -> str:
    """A short hash of what photos are called and how they were held, in whatever units and wherever the origin is."""
    return _named_digest(views, views.viewmats[:, :3, :3])


def _named_digest(views: Dataset, matrices: Float[Tensor, "B rows columns"]) -> str:
    places = (matrices.double() * 1000).round().long()  # apart from what another machine rounds otherwise
    text = repr((views.names, places.tolist()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
