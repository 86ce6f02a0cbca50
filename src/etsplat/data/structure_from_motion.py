"""Cameras for a folder of photos: structure from motion with pycolmap (an extra), on the CPU."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import torch

from etsplat.core.errors import InputError
from etsplat.core.validation import check_choice
from etsplat.data.colmap_process import Job, Mapper, Progress, import_pycolmap, place_photos, run_apart
from etsplat.data.gps_alignment import MapFit, fit_to_map
from etsplat.data.photo_intake import (
    LEAST_COUNT,
    CameraSharing,
    Photo,
    by_camera,
    list_photos,
    take_in,
    unread_pictures,
)
from etsplat.data.photo_masks import mask_file, write_masks, write_own_masks
from etsplat.data.undistortion import (
    check_output,
    check_size,
    check_space,
    undistort_masks,
    undistort_model,
    working_folder,
)
from etsplat.data.video_intake import FRAMES, frames_of_video
from etsplat.io.atomic import write_error
from etsplat.io.georeference import Georeference
from etsplat.io.paths import kind_of
from etsplat.io.photos import ARCHIVE_SUFFIXES, PHOTO_SUFFIXES

Matching = Literal["auto", "exhaustive", "sequential"]
Masks = Literal["own", "auto", "none"]
"""Those that photos bring along; those that are made of a plain background; none."""

EXHAUSTIVE_UP_TO = 120
"""With matching "auto", every pair of so many photos is compared; of more those near in order of names at first."""

LEAST_SHARE = 0.25
"""If fewer of the photos can be placed, something is wrong with them, and there is no scene."""
BYTES_PER_PHOTO = 3 << 20
"""What COLMAP writes down of a photo at most: 8,192 features of 152 bytes, and its matches."""
TURNED_GROWTH = 4
"""A HEIC file grows about so many times as a JPEG with few losses."""


@dataclass(frozen=True)
class Placement:
    """What structure from motion found.

    Attributes:
        scene: folder with images/ and sparse/0/, undistorted.
        placed: names of the photos with a camera.
        unplaced: names of those without.
        points: how many points were triangulated.
        cameras: how many different cameras took the placed photos.
        unmasked: photos that were left out because no mask could be found for them, and why; empty without masks.
        on_map: where the photos say that they were taken; None where too few of them say it. Where it is believed the
            scene has z up and a georeference.json.
        unread: names of pictures in the folder of kinds that are not read.
        masked: whether the scene has masks.
    """

    scene: Path
    placed: list[str]
    unplaced: list[str]
    points: int
    cameras: int
    unmasked: dict[str, str]
    on_map: MapFit | None = None
    unread: Sequence[str] = ()
    masked: bool = False


def find_cameras(
    photos: Path | str,
    out: Path | str,
    *,
    matching: Matching = "auto",
    cameras: CameraSharing = "auto",
    mapper: Mapper = "incremental",
    frames: int = 120,
    masks: Masks = "own",
    max_size: int = 1600,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Placement:
    """Find where photos were taken from, and write an undistorted COLMAP scene.

    Args:
        photos: folder of JPEG, PNG or HEIC files, also in subfolders; turned upright as their EXIF says. Or a video.
        out: folder of the scene; must not exist or be empty. Of a video the chosen frames are kept in its `frames/`,
            also where no scene comes of them; a second call takes them from there.
        matching: which photos are compared with each other.
        cameras: which photos have one camera and lens setting.
        mapper: place one camera after the other, or all at once.
        masks: "own" takes what photos bring along: pictures in the folder's `masks/`, called as the photos are, or that
            photos are transparent in places. "auto" makes masks of an object in front of a plain background; photos
            whose background is not plain are left out. "none" takes none. Where there are any, cameras are found by the
            object alone, which may turn in front of the background; by all of photos with masks of their own if there
            is too little on it. The scene has them in `masks/`.
        frames: of a video, so many are chosen by sharpness and motion, fewer where less moves.
        max_size: longer sides are shrunk to this many pixels, for finding features and in the scene.
        threads: None for all cores.
        progress: called with (phase, done, of how many).

    Raises:
        InputError: pycolmap is missing (of videos, imageio-ffmpeg); too few photos, or damaged ones; too few of them
            could be placed; most have no plain background, and masks are wanted; `out` cannot be used.
    """
    pycolmap = import_pycolmap()
    source, out = Path(photos), Path(out)
    is_video = source.is_file() and kind_of(source) not in (*PHOTO_SUFFIXES, *ARCHIVE_SUFFIXES)
    check_size(max_size)
    check_output(out, (FRAMES,) if is_video else ())
    check_choice("masks", masks, get_args(Masks))
    if out.resolve().is_relative_to(source.resolve()):
        raise InputError(
            f"{out}: lies in the folder of the photos, whose subfolders are read too; choose another folder"
        )
    report = progress or (lambda phase, done, total: None)
    if is_video:
        source = _frames(source, out, frames, report)
    found = list_photos(source)
    check_space(out, [photo.path for photo in found], _space_for(found))
    with working_folder(out) as work:
        upright = work / "photos"
        take_in(found, upright, threads, report)
        names = [photo.name for photo in found]
        copies, unmasked, own = {name: upright / name for name in names}, dict[str, str](), False
        if masks == "auto":
            unmasked = write_masks(copies, work / "masks", report)
        elif masks == "own":
            originals, sizes = {each.name: each.path for each in found}, {each.name: each.file.size for each in found}
            own = write_own_masks(originals, sizes, source, work / "masks")
        found = [photo for photo in found if photo.name not in unmasked]
        names = [photo.name for photo in found]
        job = Job(
            photos=upright,
            cameras=by_camera(found, cameras),
            work=work,
            exhaustive=matching == "exhaustive" or (matching == "auto" and len(names) <= EXHAUSTIVE_UP_TO),
            widens=matching == "auto",
            mapper=mapper,
            max_size=max_size,
            threads=threads or -1,
            masks=work / "masks" if masks == "auto" or own else None,
        )
        least = max(LEAST_COUNT, LEAST_SHARE * len(names))
        model = _placed_model(pycolmap, job, report)
        if own and len(_placed(model)) < least:  # little is on the object
            (work / "all").mkdir()
            model = _placed_model(pycolmap, replace(job, work=work / "all", masks=None), report)
        images = _placed(model)
        placed = sorted(image.name for image in images)
        if len(placed) < least:
            raise InputError(_too_few(source, len(placed), len(names)))
        on_map = _put_on_map(pycolmap, model, found)
        undistort_model(model, upright, placed, work, max_size, report)
        if job.masks is not None:
            undistort_masks(model, {name: mask_file(work / "masks", name) for name in placed}, work, max_size)
        if on_map is not None and on_map[1] is not None:
            on_map[1].write(work / "scene")
        _hand_over(work / "scene", out)
    return Placement(
        out,
        placed,
        [name for name in names if name not in set(placed)],
        len(model.points3D),
        len({image.camera_id for image in images}),
        unmasked,
        None if on_map is None else on_map[0],
        unread_pictures(source),
        job.masks is not None,
    )


def _placed_model(pycolmap: Any, job: Job, report: Progress) -> Any:
    folder = run_apart(place_photos, job, report=report)
    return pycolmap.Reconstruction() if folder is None else pycolmap.Reconstruction(folder)


def _placed(model: Any) -> list[Any]:
    return [image for image in model.images.values() if image.has_pose]


def _put_on_map(pycolmap: Any, model: Any, photos: list[Photo]) -> tuple[MapFit, Georeference | None] | None:
    """Turns a model as its photos' GPS says, if that is believed; the fit, and where the model lies then."""
    places = {photo.name: photo.file.place for photo in photos}
    images = [image for image in model.images.values() if image.has_pose]
    centers = torch.tensor([image.projection_center().tolist() for image in images], dtype=torch.float64)
    fit = fit_to_map(centers, [places[image.name] for image in images])
    if fit is None or not fit.believed:
        return None if fit is None else (fit, None)
    middle = centers.mean(dim=0)
    turn = fit.turn_about(middle)
    rotation = pycolmap.Rotation3d(turn.rotation.numpy())
    model.transform(pycolmap.Sim3d(turn.scale, rotation, turn.translation.numpy()))
    return fit, fit.georeference(middle)


def _frames(video: Path, out: Path, count: int, report: Progress) -> Path:
    try:
        return frames_of_video(video, out / FRAMES, count, report)
    except OSError as error:
        raise write_error(out / FRAMES, error) from error


def _hand_over(scene: Path, out: Path) -> None:
    """A whole scene gets its name; beside frames, part by part, and `sparse`, which makes it one, at last."""
    if not (out / FRAMES).is_dir():
        os.replace(scene, out)
        return
    for part in sorted(scene.iterdir()):
        os.replace(part, out / part.name)


def _space_for(photos: list[Photo]) -> int:
    """Bytes of COLMAP's database, and of the copies of photos that have to be turned or are HEIC."""
    copies = sum(photo.path.stat().st_size for photo in photos if not photo.file.upright)
    return BYTES_PER_PHOTO * len(photos) + TURNED_GROWTH * copies


def _too_few(photos: Path, placed: int, count: int) -> str:
    return (
        f"photos {photos}: only {placed} of {count} could be placed in one scene; take more photos, each overlapping"
        " its neighbours by two thirds, sharp, of something that stands still, walking around it rather than turning"
    )
