"""Scenes without lens distortion out of scenes with it, once and for all, with pycolmap (an extra)."""

import contextlib
import copy
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

from etsplat.core.errors import InputError
from etsplat.data.colmap_process import Progress, import_pycolmap, run_apart, undistort_images
from etsplat.data.formats import colmap as colmap_scenes
from etsplat.data.formats.colmap import find_model, write_tested
from etsplat.data.frames import DEPTH_FOLDERS, Frame, Points, Wanted, check_copy, check_frames, scaled_intrinsics
from etsplat.data.load import format_of
from etsplat.data.scene_files import placed_image
from etsplat.io.atomic import write_error
from etsplat.io.georeference import GEOREFERENCE_FILE
from etsplat.io.images import image_size, load_mask, load_pixels, save_image, size_for
from etsplat.io.locks import scratch_folder
from etsplat.io.paths import path_remedy
from etsplat.io.photos import write_upright

LEAST_SIZE = 16
"""Pixels of the longer side of an image."""

_LITTLE_SPACE = 64 << 20

_GROWTH, _SPARE_BYTES = 4, 1 << 20
"""COLMAP writes JPEG with few losses: files grow. Beside them lies the model."""


def undistort_scene(
    scene: Path | str, out: Path | str, *, max_size: int = 1600, tell: Callable[[str], None] = lambda note: None
) -> list[str]:
    """Write a scene anew in COLMAP's layout without lens distortion: images, masks, cameras, points.

    Args:
        scene: folder with `images/` and `sparse/0/` (or `sparse/`), of any of COLMAP's camera models; or of any other
            layout that is read (`docs/captures.md`). `masks/`, or the masks that it names, come along.
        out: folder of the new scene; must not exist or be empty.
        max_size: longer sides are shrunk to this many pixels.
        tell: is called with what is left out or not understood, a sentence each.

    Returns:
        The names of the images. Those for testing are the scene's own, if it says which; else every 8th.

    Raises:
        InputError: pycolmap is missing; there is no scene, or it cannot be read; images are missing, damaged or
            transparent; `out` cannot be used; the disk is full.
    """
    pycolmap = import_pycolmap()
    scene, out = Path(scene), Path(out)
    if not scene.is_dir():
        raise InputError(f"scene {scene}: no such folder; {path_remedy(scene)}")
    layout = format_of(scene)
    colmap = find_model(scene) if layout.MARK == colmap_scenes.MARK else None
    check_size(max_size)
    check_output(out)
    listing = layout.list_frames(scene, Wanted())
    train, tested = listing.split or (range(len(listing.frames)), None)
    frames = sorted((listing.frames[view] for view in (*train, *(tested or ()))), key=lambda frame: frame.name)
    if colmap is not None:
        model, photos, masks = _read_model(pycolmap, scene, colmap)
    else:
        check_frames(scene, frames)
        photos = _common_folder(scene, frames)
        model, masks = _make_model(pycolmap, scene, photos, frames, listing.points)
    names = _placed(model)
    _check_pictures(scene, [photos / name for name in names], masks.values())
    check_space(out, [*(photos / name for name in names), *masks.values(), *masks.values()])
    with working_folder(out) as work:
        undistort_model(model, _as_cameras_have_them(model, photos, names, work), names, work, max_size)
        if masks:
            undistort_masks(model, masks, work, max_size)
        if (scene / GEOREFERENCE_FILE).is_file():
            shutil.copyfile(scene / GEOREFERENCE_FILE, work / "scene" / GEOREFERENCE_FILE)
        elif listing.georeference is not None:
            listing.georeference.write(work / "scene")
        if tested is not None:
            files = sorted(listing.frames[view].image.relative_to(photos).as_posix() for view in tested)
            write_tested(work / "scene" / "sparse" / "0", files)
        os.replace(work / "scene", out)
    for note in (*listing.notes, *_left_behind(scene, frames)):
        tell(note)
    return names


def _left_behind(scene: Path, frames: Sequence[Frame]) -> Iterator[str]:
    for folder in DEPTH_FOLDERS:
        if (scene / folder).is_dir():
            yield f"{folder}/ stays behind: depth maps are not freed of distortion"
    if all(frame.lens is None for frame in frames):
        yield "no photo has lens distortion: the scene can be used as it was"


def _check_pictures(scene: Path, photos: list[Path], masks: Iterable[Path]) -> None:
    """Raises InputError where one is damaged, of which COLMAP takes what is there, or a photo is transparent."""
    with ThreadPoolExecutor() as pool:
        for photo, channels in zip(photos, pool.map(_channels, photos), strict=True):
            if channels == 4:
                raise InputError(f"image {photo}: has transparency, which would be lost; put it into {scene}/masks")
        for _ in pool.map(load_mask, masks):
            pass


def _channels(photo: Path) -> int:
    return load_pixels(photo, *image_size(photo)).shape[2]


def _as_cameras_have_them(model: Any, photos: Path, names: list[str], work: Path) -> Path:
    """The folder of the photos; WORK/upright with all of them, where some lie on their side and their cameras do not.

    COLMAP reads pixels as they are stored.
    """
    cameras = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    shapes = {name: (cameras[name].width, cameras[name].height) for name in names}
    lying = {name for name in names if size_for(photos / name, shapes[name]) != image_size(photos / name)}
    if not lying:
        return photos
    for name in names:
        target = work / "upright" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (write_upright if name in lying else shutil.copyfile)(photos / name, target)
    return work / "upright"


def undistort_model(
    model: Any, photos: Path, names: list[str], work: Path, max_size: int, report: Progress | None = None
) -> None:
    """Writes images/ and sparse/0/ of a model's images into WORK/scene."""
    shutil.rmtree(work / "model", ignore_errors=True)
    (work / "model").mkdir()
    model.write(work / "model")
    scene = work / "scene"
    run_apart(undistort_images, work / "model", photos, names, scene, max_size, report=report)
    # Left of what COLMAP writes for its dense reconstruction are images/ and sparse/0/.
    for entry in scene.iterdir():
        if entry.name == "stereo":
            shutil.rmtree(entry)
        elif entry.is_file():
            entry.unlink()
    (scene / "sparse").rename(scene / "0")
    (scene / "sparse").mkdir()
    (scene / "0").rename(scene / "sparse" / "0")
    written = sum((scene / "images" / name).is_file() for name in names)
    if written < len(names):  # COLMAP reports nothing
        raise RuntimeError(f"{written} of {len(names)} images could be written")


def check_size(max_size: int) -> None:
    """Raises InputError if images would vanish."""
    if max_size < LEAST_SIZE:
        raise InputError(f"max_size: is {max_size}; it must be at least {LEAST_SIZE}")


def check_output(out: Path, may_hold: tuple[str, ...] = ()) -> None:
    """Raises InputError if `out` exists and is not an empty folder, or cannot be made.

    Args:
        out: folder that is to be written.
        may_hold: names of what may lie in it all the same.
    """
    if out.exists() and (not out.is_dir() or any(entry.name not in may_hold for entry in out.iterdir())):
        raise InputError(f"{out}: is there already and not empty; choose another folder")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from error


def check_space(out: Path, images: Sequence[Path], more: int = 0) -> None:
    """Raises InputError if images without distortion and `more` bytes may not fit beside `out`.

    COLMAP does not say what failed when it finds the disk full, so it should not come to that.
    """
    needed = more + _SPARE_BYTES + _GROWTH * sum(image.stat().st_size for image in images)
    free = shutil.disk_usage(out.parent).free
    if needed > free:
        raise InputError(
            f"cannot write {out}: {len(images)} images may take {needed >> 20} MiB there and {free >> 20} MiB are free;"
            " free some space on that disk or choose another folder"
        )


@contextlib.contextmanager
def working_folder(out: Path) -> Iterator[Path]:
    """`scratch_folder` beside `out`. What COLMAP and the system say of a full disk is an InputError."""
    try:
        with scratch_folder(out) as folder:
            try:
                yield folder
            except InputError:
                raise
            except (RuntimeError, ValueError) as error:  # what pycolmap's C++ throws
                raise _failure(out, error) from error
    except OSError as error:
        raise write_error(out, error) from error


def _failure(out: Path, error: Exception) -> InputError:
    """Made while the working folder still takes its space."""
    detail = (str(error) or type(error).__name__).splitlines()[0]
    free = shutil.disk_usage(out.parent).free
    remedy = "free some space or choose another folder" if free < _LITTLE_SPACE else "is there enough memory?"
    return InputError(
        f"cannot write {out}: COLMAP failed ({detail}), with {free >> 20} MiB free on that disk; {remedy}"
    )


def _placed(model: Any) -> list[str]:
    return sorted(image.name for image in model.images.values() if image.has_pose)


def _read_model(pycolmap: Any, scene: Path, folder: Path) -> tuple[Any, Path, dict[str, Path]]:
    """A COLMAP scene's model for the images that are there, which may be copies.

    And the folder that its images are named in now, and masks by these names.
    """
    try:
        model = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError, LookupError) as error:  # what its C++ throws
        raise InputError(f"scene {folder}: cannot be read as a model ({str(error).splitlines()[0]})") from error
    found = {name: placed_image(scene, name, folder, Wanted(), any_end=False) for name in _placed(model)}
    files = {name: path for name, (_, path) in found.items()}
    missing = [name for name, path in files.items() if not path.is_file()]
    if missing:
        raise InputError(f"scene {scene}: {len(missing)} images are missing (first: {missing[0]}); copy them there")
    if len(set(files.values())) < len(files):
        raise InputError(f"scene {scene}: two images of the model are one file here; keep the folders they were in")
    photos = scene / "images" if all(path.is_relative_to(scene / "images") for path in files.values()) else scene
    named = ((path, Wanted().mask_of(scene, name, folder)) for name, path in found.values())
    masks = {path.relative_to(photos).as_posix(): mask for path, mask in named if mask is not None}
    return _of_files(pycolmap, scene, photos, model, files), photos, masks


def _of_files(pycolmap: Any, scene: Path, photos: Path, model: Any, files: dict[str, Path]) -> Any:
    """The model with images named as their files; if some have another size than their camera, made anew with it."""
    images = [image for image in model.images.values() if image.name in files]
    sizes, fit = {}, True
    for image in images:
        camera, file = model.cameras[image.camera_id], files[image.name]
        whole = camera.width, camera.height
        sizes[image.image_id] = size = size_for(file, whole)
        check_copy(scene, image.name, size, whole)
        fit = fit and size == whole
        image.name = file.relative_to(photos).as_posix()
    if fit:
        return model
    resized = pycolmap.Reconstruction()
    for image in images:
        camera = copy.deepcopy(model.cameras[image.camera_id])
        camera.rescale(*sizes[image.image_id])
        _add_image(pycolmap, resized, image.image_id, image.name, camera, image.cam_from_world())
    for point in model.points3D.values():
        resized.add_point3D(point.xyz, pycolmap.Track(), point.color)
    return resized


def _add_image(pycolmap: Any, model: Any, index: int, name: str, camera: Any, pose: Any) -> None:
    """With a camera of its own."""
    camera.camera_id = index
    model.add_camera_with_trivial_rig(camera)
    model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=index, image_id=index), pose)


def _common_folder(scene: Path, frames: list[Frame]) -> Path:
    """The folder in the scene where all images lie, or the scene."""
    outside = [frame.name for frame in frames if not frame.image.is_relative_to(scene)]
    if outside:
        raise InputError(f"scene {scene}: {outside[0]} lies outside of it; copy the images into it")
    folders = {frame.image.relative_to(scene).parts[:-1][:1] for frame in frames}
    return scene.joinpath(*folders.pop()) if len(folders) == 1 else scene


def _make_model(
    pycolmap: Any, scene: Path, photos: Path, frames: list[Frame], points: Points | None
) -> tuple[Any, dict[str, Path]]:
    """A model of frames with their lenses, at the size of their files, and of points; and masks by image."""
    model, masks = pycolmap.Reconstruction(), {}
    for index, frame in enumerate(frames, 1):
        name, size = frame.image.relative_to(photos).as_posix(), size_for(frame.image, frame.size)
        K = scaled_intrinsics(scene, frame, size, size)
        lens, coefficients = ("PINHOLE", ()) if frame.lens is None else (frame.lens.model, frame.lens.coefficients)
        params = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *coefficients]
        camera = pycolmap.Camera(model=lens, width=size[0], height=size[1], params=params)
        _add_image(pycolmap, model, index, name, camera, pycolmap.Rigid3d(frame.viewmat[:3].numpy()))
        if frame.mask is not None:
            masks[name] = frame.mask
    if points is not None:
        for point, color in zip(points[0].numpy(), points[1].mul(255).round().byte().numpy(), strict=True):
            model.add_point3D(point, pycolmap.Track(), color)
    return model, masks


def undistort_masks(model: Any, masks: dict[str, Path], work: Path, max_size: int) -> None:
    """Masks go the way of the images, under their names, into WORK/scene/masks."""
    (work / "images").mkdir()
    (work / "scene").rename(work / "whole")
    for image in model.images.values():
        mask, camera = masks[image.name], model.cameras[image.camera_id]
        image.name = str(PurePosixPath(image.name).with_suffix(mask.suffix))
        target, size = work / "images" / image.name, (camera.width, camera.height)
        target.parent.mkdir(parents=True, exist_ok=True)
        if image_size(mask) == size:
            shutil.copyfile(mask, target)
        else:
            save_image(target, load_mask(mask, size)[..., None])
    undistort_model(model, work / "images", sorted(image.name for image in model.images.values()), work, max_size)
    (work / "scene" / "images").rename(work / "whole" / "masks")
    shutil.rmtree(work / "scene")
    (work / "whole").rename(work / "scene")
