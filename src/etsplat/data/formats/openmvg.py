"""OpenMVG's `sfm_data.json`: views, intrinsics, extrinsics, structure; the images in the folder, or in its `images`.

A pose is a rotation from world to camera, row by row, with OpenCV's axes, and the camera's centre. Focal length and
principal point are in pixels, and taken as OpenMVG's converter to COLMAP passes them on. The kind of a camera is named
where it first occurs; later ones refer to it by a number (the archive is cereal's). Its coefficients are OpenCV's:
`disto_k1`, `disto_k3` (k1, k2, k3), `disto_t2` (k1, k2, k3, p1, p2), `fisheye` (k1 to k4).
Source: OpenMVG's documentation (openmvg.readthedocs.io, "cameras" and "sfm") and files that it wrote.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from etsplat.data.frames import Frame, Lens, Listing, Points, Wanted, pinhole
from etsplat.data.scene_files import (
    Entry,
    brown_lens,
    entries_of,
    fisheye_lens,
    placed_image,
    points_of,
    read_object,
    unplaced_note,
)

MARK = "sfm_data.json"
RANK = 6

_NAMED = 1 << 31
"""Added to the number of a kind where it is named."""

_NOWHERE = (1 << 32) - 1
"""The number of no intrinsics, or of no pose."""


def _brown(entry: Entry, key: str, count: int) -> Lens | None:
    return brown_lens(f"lens distortion ({key})", *entry.numbers(key, count).tolist())


_LENSES: Mapping[str, Callable[[Entry], Lens | None]] = {
    "pinhole": lambda entry: None,
    "pinhole_radial_k1": lambda entry: _brown(entry, "disto_k1", 1),
    "pinhole_radial_k3": lambda entry: _brown(entry, "disto_k3", 3),
    "pinhole_brown_t2": lambda entry: _brown(entry, "disto_t2", 5),
    "fisheye": lambda entry: fisheye_lens("a fisheye camera", *entry.numbers("fisheye", 4).tolist()),
}


def recognises(folder: Path) -> bool:
    """Whether the file is there."""
    return (folder / MARK).is_file()


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The views that have a pose and intrinsics, sorted by name, and the structure's points.

    Raises:
        InputError: the file is damaged; a camera is of a kind that is not known here; a mask is missing.
    """
    path = folder / MARK
    document = read_object(path)
    views = _values(path, document, "views", "view")
    cameras = dict(_values(path, document, "intrinsics", "camera"))
    poses = dict(_values(path, document, "extrinsics", "pose"))
    kinds = _kinds(path, document)
    frames = []
    for _, view in views:
        pose, identity = poses.get(view.whole("id_pose", _NOWHERE)), view.whole("id_intrinsic", _NOWHERE)
        if pose is None or identity not in cameras:
            continue
        camera, kind = cameras[identity], kinds.get(identity, "of a kind without a name")
        if kind not in _LENSES:
            raise camera.wrong(f"is {kind!s:.40}, which is not read; undistort the images with OpenMVG")
        name, image = placed_image(folder, f"{view.text('local_path', '')}/{view.text('filename')}", path, wanted)
        focal, (cx, cy) = camera.number("focal_length"), camera.numbers("principal_point", 2).tolist()
        viewmat = pose.viewmat(pose.numbers("rotation", 9).reshape(3, 3).T, pose.numbers("center", 3))
        mask = wanted.mask_of(folder, name, path)
        K = pinhole(focal, focal, cx, cy)
        frames.append(Frame(name, image, mask, viewmat, K, camera.size(), _LENSES[kind](camera)))
    frames.sort(key=lambda frame: frame.name)
    return Listing(frames, points=_points(path, document), notes=unplaced_note(len(views) - len(frames), len(views)))


def _values(path: Path, document: Mapping[str, Any], key: str, name: str) -> list[tuple[int, Entry]]:
    """What a list of pairs of a key and a value says, by key; data behind pointers and of base classes in one."""
    found = []
    for pair in entries_of(path, document, key, name):
        number = pair.whole("key")
        said = pair.said.get("value")
        if isinstance(said, dict) and isinstance(said.get("ptr_wrapper"), dict):
            said = said["ptr_wrapper"].get("data")
        if isinstance(said, dict) and isinstance(said.get("value0"), dict):
            said = {**said["value0"], **said}
        if not isinstance(said, dict):
            raise pair.wrong("has no data; export it again")
        found.append((number, Entry(path, f"{name} {number}", said)))
    return found


def _kinds(path: Path, document: Mapping[str, Any]) -> dict[int, str]:
    """The kinds of the cameras, by their keys."""
    named: dict[int, str] = {}
    found = {}
    for pair in entries_of(path, document, "intrinsics", "camera"):
        said = pair.said.get("value")
        value = Entry(path, pair.name, said if isinstance(said, dict) else {})
        number = value.whole("polymorphic_id", 0) % _NAMED
        if "polymorphic_name" in value.said:
            named[number] = value.text("polymorphic_name")
        if number in named:
            found[pair.whole("key")] = named[number]
    return found


def _points(path: Path, document: Mapping[str, Any]) -> Points | None:
    if not document.get("structure"):
        return None
    places = [entry.floats("X", 3) for _, entry in _values(path, document, "structure", "point")]
    return points_of(torch.tensor(places, dtype=torch.float64), None)
