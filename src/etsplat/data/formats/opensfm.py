"""OpenSfM's `reconstruction.json`, also in the folder `opensfm/` of a project of OpenDroneMap (ODM, WebODM).

A list of reconstructions: photos that hang together. A shot's `rotation` is an axis times an angle, from the world to
the camera, with OpenCV's axes, and its `translation` follows: X_camera = R X + t. Focal lengths and principal points
are parts of the image's longer side, the latter from its middle. `k1`, `k2` of perspective, simple_radial and radial
cameras and `k1` to `k3`, `p1`, `p2` of brown ones are OpenCV's; so are those of fisheye (k1, k2) and fisheye_opencv
(k1 to k4) cameras. Pixels are those of the file as it is stored, whatever EXIF says. With `reference_lla`, where the
origin is, the world is topocentric: x east, y north, z up, metres.
Source: OpenSfM's documentation (opensfm.org/docs, "dataset" and "geometry") and files that it and ODM wrote.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Lens, Listing, Points, Wanted
from etsplat.data.scene_files import (
    Entry,
    brown_lens,
    fisheye_lens,
    head_of,
    pinhole_of,
    placed_image,
    points_of,
    quaternion_rotation,
    read_json,
    unplaced_beside,
)
from etsplat.io.georeference import Georeference

MARK = "reconstruction.json of OpenSfM"
RANK = 12

_PLACES = ("reconstruction.json", "opensfm/reconstruction.json")

_BROWN = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "k3", "p1", "p2"),
}
"""Coefficients of each kind of camera, in the order of `brown_lens`."""

_FISHEYE = {"fisheye": ("k1", "k2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def recognises(folder: Path) -> bool:
    """Whether there is such a file, which is a list."""
    return any(head_of(folder / place).lstrip().startswith("[") for place in _PLACES)


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The shots of the reconstruction with the most, sorted by name, and its points.

    Raises:
        InputError: the file is damaged; a camera is of a kind that is not known here; a mask is missing.
    """
    path = next((folder / place for place in _PLACES if (folder / place).is_file()), folder / _PLACES[0])
    document = read_json(path)
    if not isinstance(document, list) or not document or not all(isinstance(part, dict) for part in document):
        raise InputError(f"scene {path}: is no list of reconstructions; run OpenSfM again")
    counts = [len(_objects(path, part, "shots", "shot")) for part in document]
    largest = document[max(range(len(document)), key=counts.__getitem__)]
    cameras = _objects(path, largest, "cameras", "camera")
    frames = []
    for name, shot in _objects(path, largest, "shots", "shot").items():
        camera = cameras.get(shot.text("camera"))
        if camera is None:
            raise shot.wrong("uses a camera that is not there; run OpenSfM again")
        named, image = placed_image(folder, name, path, wanted)
        rotation = _rotation(shot)
        viewmat = shot.viewmat(rotation.T, -rotation.T @ shot.numbers("translation", 3))
        mask = wanted.mask_of(folder, named, path)
        frames.append(Frame(named, image, mask, viewmat, _intrinsics(camera), camera.size(), _lens(camera)))
    frames.sort(key=lambda frame: frame.name)
    notes = unplaced_beside(frames)
    if len(document) > 1:
        notes += (f"{len(document)} reconstructions: that with the most photos, {max(counts)}, is read, and no other",)
    return Listing(frames, points=_points(path, largest), notes=notes, georeference=_georeference(path, largest))


def _objects(path: Path, part: Mapping[str, Any], key: str, name: str) -> dict[str, Entry]:
    """What a reconstruction says of shots, cameras or points, by their names."""
    found = part.get(key, {})
    if not isinstance(found, dict) or not all(isinstance(said, dict) for said in found.values()):
        raise InputError(f"scene {path}: `{key}` of a reconstruction is no object of objects; run OpenSfM again")
    return {own: Entry(path, f"{name} {own!r:.80}", said) for own, said in found.items()}


def _rotation(shot: Entry) -> Float[Tensor, "3 3"]:
    """World to camera."""
    turn = shot.numbers("rotation", 3)
    angle = float(turn.norm())
    x, y, z = (turn * (math.sin(angle / 2) / angle if angle > 0 else 0.0)).tolist()
    return quaternion_rotation(math.cos(angle / 2), x, y, z)


def _intrinsics(camera: Entry) -> Float[Tensor, "3 3"]:
    """K in pixels."""
    size = camera.size()
    longer = max(size)
    if "focal" in camera.said:
        fx = fy = camera.number("focal") * longer
    else:
        fx, fy = camera.number("focal_x") * longer, camera.number("focal_y") * longer
    return pinhole_of(fx, (camera.number("c_x", 0.0) * longer, camera.number("c_y", 0.0) * longer), size, fy)


def _lens(camera: Entry) -> Lens | None:
    kind = camera.text("projection_type", "perspective")
    known = _BROWN.get(kind, _FISHEYE.get(kind))
    if known is None:
        raise camera.wrong(f"is of type {kind:.40}, which is not read; solve with another (ODM: --camera-lens brown)")
    values = {key: camera.number(key, 0.0) for key in _COEFFICIENTS}
    if odd := [key for key, value in values.items() if value != 0 and key not in known]:
        raise camera.wrong(
            f"of type {kind} has {', '.join(odd)}, which is not read; solve without (ODM: --camera-lens brown)"
        )
    if kind in _FISHEYE:
        return fisheye_lens(f"a {kind} camera", *(values[key] for key in ("k1", "k2", "k3", "k4")))
    return brown_lens(f"lens distortion ({kind})", *(values[key] for key in known))


def _points(path: Path, part: Mapping[str, Any]) -> Points | None:
    found = list(_objects(path, part, "points", "point").values())
    if not found:
        return None
    places = torch.tensor([entry.floats("coordinates", 3) for entry in found], dtype=torch.float64)
    colors = torch.tensor([entry.floats("color", 3, [128.0] * 3) for entry in found], dtype=torch.float64)
    return points_of(places, colors)


def _georeference(path: Path, part: Mapping[str, Any]) -> Georeference | None:
    """Which axis is up, and where the origin is; None where the photos did not know their places."""
    if not isinstance(part.get("reference_lla"), dict):
        return None
    origin = Entry(path, "reference_lla", part["reference_lla"])
    latitude, longitude, altitude = (origin.number(key) for key in ("latitude", "longitude", "altitude"))
    if latitude == longitude == altitude == 0:  # which is written without them
        return None
    place = f"latitude {latitude:.12g}, longitude {longitude:.12g}, altitude {altitude:.12g} (WGS 84)"
    return Georeference(up="z", crs=f"east, north and up in metres from {place}")
