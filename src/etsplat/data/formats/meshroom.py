"""Meshroom's (AliceVision's) scenes as JSON: `sfm.json` of the node ConvertSfMFormat, or `cameras.sfm`.

Numbers are written as texts. A pose is a rotation from world to camera, column by column, with OpenCV's axes, and the
camera's centre. What a camera says depends on the file's version. The principal point is in pixels from the upper left
corner before 1.2.1, from the middle of the image since. The focal length is in pixels (`pxFocalLength`, two numbers
since 1.2.0), and since 1.2.2 in millimetres on a sensor of `sensorWidth` over the image's width; `pixelRatio` is
fx / fy before 1.2.5 and fy / fx since. Distortion is radial (`radial1`, `radial3`), `brown` (k1, k2, k3, p1, p2) or
`fisheye4`, all as OpenCV has them; its name stands in `type`, later in `distortionType`.
Source: AliceVision's description of its files (SfmDataIO changelog) and the fields that its reader takes.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Lens, Listing, Points, Wanted, pinhole
from etsplat.data.scene_files import (
    Entry,
    brown_lens,
    entries_of,
    fisheye_lens,
    head_of,
    only_one,
    placed_image,
    points_of,
    read_object,
    unplaced_note,
)

MARK = "sfm.json or cameras.sfm"
RANK = 5

_KINDS = {"radial1": 1, "radialk1": 1, "radial3": 3, "radialk3": 3, "brown": 5, "fisheye4": 4, "fisheye": 4}
"""Coefficients of each kind of distortion."""

Version = tuple[int, int, int]


def recognises(folder: Path) -> bool:
    """Whether there is such a file."""
    return bool(_files(folder))


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The views that have a pose, sorted by name, and the structure's points.

    Raises:
        InputError: several files; a file is damaged; rigs; a lens that is not known here; a mask is missing.
    """
    path = only_one(folder, _files(folder))
    if path is None:
        raise InputError(f"scene {folder}: no {MARK}; export the scene again")
    document = read_object(path)
    whole = Entry(path, "the scene", document)
    version = tuple(int(number) for number in whole.numbers("version", 3, [1.0, 0.0, 0.0]).clamp(0, 1e6))
    views = entries_of(path, document, "views", "view")
    cameras = {entry.text("intrinsicId"): entry for entry in entries_of(path, document, "intrinsics", "camera")}
    poses = {entry.text("poseId"): entry for entry in entries_of(path, {"poses": [], **document}, "poses", "pose")}
    frames = []
    for view in views:
        pose, camera = poses.get(view.text("poseId", "")), cameras.get(view.text("intrinsicId", ""))
        if "rigId" in view.said:
            raise view.wrong("is of a rig of cameras, which is not read; solve the scene without rigs")
        if pose is None or camera is None:
            continue
        name, image = placed_image(folder, view.text("path"), path, wanted)
        transform = pose.inner("pose").inner("transform")
        rotation = transform.numbers("rotation", 9).reshape(3, 3)  # transposed: the camera's to the world
        viewmat = transform.viewmat(rotation, transform.numbers("center", 3))
        mask = wanted.mask_of(folder, name, path)
        K = _intrinsics(camera, (version[0], version[1], version[2]))
        frames.append(Frame(name, image, mask, viewmat, K, camera.size(), _lens(camera)))
    frames.sort(key=lambda frame: frame.name)
    return Listing(frames, points=_points(path, document), notes=unplaced_note(len(views) - len(frames), len(views)))


def _files(folder: Path) -> list[Path]:
    found = [path for path in sorted(folder.glob("*.sfm")) if '"views"' in head_of(path)]
    return [folder / "sfm.json"] if (folder / "sfm.json").is_file() else found


def _intrinsics(camera: Entry, version: Version) -> torch.Tensor:
    """K in pixels."""
    width, height = camera.size()
    cx, cy = camera.numbers("principalPoint", 2).tolist()
    if version >= (1, 2, 1):
        cx, cy = cx + width / 2, cy + height / 2
    if version < (1, 2, 0):
        fx = fy = camera.number("pxFocalLength")
    elif version < (1, 2, 2):
        fx, fy = camera.numbers("pxFocalLength", 2).tolist()
    else:
        sensor, ratio = camera.number("sensorWidth", 36.0), camera.number("pixelRatio", 1.0)
        if not (sensor > 0 and ratio > 0):
            raise camera.wrong(f"has sensorWidth = {sensor:g} and pixelRatio = {ratio:g}; both must be positive")
        fx = camera.number("focalLength") / sensor * width
        fy = fx / ratio if version < (1, 2, 5) else fx * ratio
    return pinhole(fx, fy, cx, cy)


def _lens(camera: Entry) -> Lens | None:
    kind = camera.text("type", "pinhole").lower()
    if kind == "pinhole":
        kind = camera.text("distortionType", "none").lower()
    given = camera.said.get("distortionParams") or []
    if kind in ("none", "pinhole") or (not given and kind in _KINDS):
        return None
    if kind not in _KINDS:
        raise camera.wrong(f"is of type {kind:.40}, which is not read; undistort the images (PrepareDenseScene)")
    values = camera.numbers("distortionParams", _KINDS[kind]).tolist()
    told = f"lens distortion ({kind})"
    return fisheye_lens(told, *values) if kind.startswith("fisheye") else brown_lens(told, *values)


def _points(path: Path, document: Mapping[str, Any]) -> Points | None:
    if not document.get("structure"):
        return None
    found = entries_of(path, document, "structure", "point")
    places = torch.tensor([entry.floats("X", 3) for entry in found], dtype=torch.float64)
    colors = torch.tensor([entry.floats("color", 3, [128.0] * 3) for entry in found], dtype=torch.float64)
    return points_of(places, colors)
