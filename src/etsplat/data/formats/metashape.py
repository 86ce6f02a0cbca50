"""Metashape's (PhotoScan's) cameras as XML: *File > Export > Export Cameras*, "Agisoft XML", under any name.

A camera's `transform` leads from its own axes, OpenCV's, to the chunk's, and the transform of its component, or of the
chunk (rotation, scale, translation), from there to the world, which of a georeferenced chunk is geocentric.
Images: u = w/2 + cx + f x' + b1 x' + b2 y', v = h/2 + cy + f y', the centre of the first pixel being at 0.5, and
x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y, so that p1 is OpenCV's p2, and p2 its p1.
Of a fisheye camera r is the angle to the axis. Source: Agisoft Metashape User Manual, appendix "Camera models".
"""

from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Lens, Listing, Wanted, pinhole
from etsplat.data.scene_files import (
    Entry,
    brown_lens,
    fisheye_lens,
    head_of,
    only_one,
    placed_image,
    points_beside,
    read_xml,
    unplaced_note,
)
from etsplat.geometry.similarity import Similarity

MARK = "cameras.xml of Metashape"
RANK = 8

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b2")


def recognises(folder: Path) -> bool:
    """Whether there is an XML file with a chunk."""
    return bool(_files(folder))


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The cameras of the largest component that are enabled and aligned, sorted by name; points of `points.ply`.

    Raises:
        InputError: several files or chunks; a file is damaged; a sensor of several lenses; a lens that is not known
            here; a mask is missing.
    """
    path = only_one(folder, _files(folder))
    if path is None:
        raise InputError(f"scene {folder}: no XML of Metashape; export the cameras again")
    chunks = [chunk for chunk in read_xml(path).iter("chunk") if chunk.find("cameras") is not None]
    if len(chunks) != 1:
        raise InputError(f"scene {path}: has {len(chunks)} chunks with cameras; export one")
    chunk = chunks[0]
    calibrations = {sensor.get("id", ""): _calibration(path, sensor) for sensor in chunk.iterfind("sensors/sensor")}
    cameras = list(chunk.iterfind("cameras//camera"))
    placed = [camera for camera in cameras if _enabled(camera) and camera.find("transform") is not None]
    counts = Counter(camera.get("component_id", "") for camera in placed)
    largest = counts.most_common(1)[0][0] if counts else ""
    world = _world(path, chunk, largest)
    frames = []
    for camera in placed:
        if camera.get("component_id", "") != largest:
            continue
        entry = Entry(
            path,
            f"camera {camera.get('label', camera.get('id', ''))!r:.80}",
            {"transform": camera.findtext("transform")},
        )
        calibration = calibrations.get(camera.get("sensor_id", ""))
        if calibration is None:
            raise entry.wrong("has no sensor with a calibration; export the cameras again")
        name, image = placed_image(folder, camera.get("label", ""), path, wanted)
        matrix = entry.numbers("transform", 16).reshape(4, 4)
        viewmat = entry.viewmat(world.rotation @ matrix[:3, :3], world.apply(matrix[:3, 3]))
        mask = wanted.mask_of(folder, name, path)
        K, lens = _camera(calibration)
        frames.append(Frame(name, image, mask, viewmat, K, calibration.size(), lens))
    frames.sort(key=lambda frame: frame.name)
    notes = unplaced_note(len(cameras) - len(placed), len(cameras), "are disabled or not aligned")
    notes += unplaced_note(len(placed) - len(frames), len(cameras), "are of other components")
    return Listing(frames, points=points_beside(folder, frames) if frames else None, notes=notes)


def _files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("*.xml")) if "<document" in head_of(path) and "<chunk" in head_of(path)]


def _entry(path: Path, name: str, element: Element) -> Entry:
    """What an element's children say, and its attributes."""
    said = {child.tag: child.text for child in element if child.text is not None}
    return Entry(path, f"{name} {element.get('label', element.get('id', ''))!r:.80}", {**element.attrib, **said})


def _enabled(camera: Element) -> bool:
    return camera.get("enabled", "true").lower() not in ("false", "0")


def _calibration(path: Path, element: Element) -> Entry | None:
    """What was adjusted of a sensor, or else what it started from; None without."""
    sensor = _entry(path, "sensor", element)
    if "master_id" in sensor.said and sensor.said["master_id"] != sensor.said.get("id"):
        raise sensor.wrong("is one of several lenses of a camera, which is not read; export them as single cameras")
    found = {calibration.get("class", ""): calibration for calibration in element.iterfind("calibration")}
    chosen = found.get("adjusted", found.get("initial", found.get("")))
    if chosen is None:
        return None
    resolution = chosen.find("resolution")
    resolution = element.find("resolution") if resolution is None else resolution
    size = {} if resolution is None else {key: resolution.get(key) for key in ("width", "height")}
    said = _entry(sensor.path, "sensor", chosen).said
    return Entry(sensor.path, sensor.name, {"type": sensor.said.get("type", "frame"), **said, **size})


def _camera(calibration: Entry) -> tuple[Float[Tensor, "3 3"], Lens | None]:
    """K and lens."""
    width, height = calibration.size()
    k1, k2, k3, k4, p1, p2, p3, p4, b2 = (calibration.number(key, 0.0) for key in _COEFFICIENTS)
    focal, kind = calibration.number("f"), calibration.text("type", "frame")
    K = pinhole(
        focal + calibration.number("b1", 0.0),
        focal,
        width / 2 + calibration.number("cx", 0.0),
        height / 2 + calibration.number("cy", 0.0),
    )
    if kind == "frame" and p3 == p4 == k4 == b2 == 0:
        return K, brown_lens("lens distortion", k1, k2, k3, p2, p1)
    if kind == "fisheye" and p1 == p2 == p3 == p4 == b2 == 0:
        return K, fisheye_lens("a fisheye camera", k1, k2, k3, k4)
    known = {"frame": ("k4", "p3", "p4", "b2"), "fisheye": ("p1", "p2", "p3", "p4", "b2")}.get(kind)
    odd = (
        f"of type {kind:.40}"
        if known is None
        else f"with {', '.join(key for key in known if calibration.number(key, 0.0))}"
    )
    raise calibration.wrong(f"is {odd}, which is not read; align without these, or undistort the photos in Metashape")


def _world(path: Path, chunk: Element, component: str) -> Similarity:
    """From the chunk's axes to the world's."""
    found = next((each for each in chunk.iterfind("components/component") if each.get("id") == component), None)
    element = None if found is None else found.find("transform")
    element = chunk.find("transform") if element is None else element
    if element is None:
        return Similarity()
    entry = _entry(path, "the transform of the chunk", element)
    scale, rotation = entry.number("scale", 1.0), torch.eye(3, dtype=torch.float64)
    rotation = entry.numbers("rotation", 9, rotation.flatten().tolist()).reshape(3, 3)
    if not 1e-15 < scale < 1e15 or not torch.allclose(rotation.T @ rotation, torch.eye(3).double(), atol=1e-3):
        raise entry.wrong("is no similarity; export the cameras again")
    return Similarity(rotation, scale, entry.numbers("translation", 3, [0.0, 0.0, 0.0]))
