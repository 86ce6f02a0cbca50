"""RealityCapture's (RealityScan's) registration: CSV of "Internal/External camera parameters", or XMP beside images.

Both: the focal length is that of a frame 36 mm wide, the principal point a part of the image's longer side from its
middle, and the coefficients are k1, k2, k3, k4, t1, t2 of Brown's model, where t1 is OpenCV's p2 and t2 its p1 (the
program's template for OpenCV writes k1, k2, t2, t1).
CSV: the camera's place is x, y, alt; its axes (x right, y up, looking along -z) are turned to the world's (z up) by
Rz(-heading) Rx(pitch) Ry(roll), in degrees. Newer versions call the columns yaw, f_35mm, px_norm and py_norm. The
distortion model is not named: Brown's, which is the program's default, is supposed.
XMP: `Rotation` leads from world to camera, row by row, with OpenCV's axes, and `Position` is the camera's place.
Source: "RealityCapture XMP Camera Math" (support.capturingreality.com); the templates in calibration.xml, which comes
with the program; nerfstudio for the order of the angles.
"""

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Lens, Listing, Wanted
from etsplat.data.scene_files import (
    OPENGL,
    Entry,
    brown_lens,
    head_of,
    only_one,
    pinhole_of,
    placed_image,
    points_beside,
    read_text,
    read_xml,
    size_of,
    unplaced_note,
)

MARK = "a CSV of RealityCapture's camera parameters or its .xmp files"
RANK = 9

_NEWER = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""Columns by the names that they have now."""

_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "t1", "t2")
_KNOWN = (*_NEEDED, "px", "py", *_COEFFICIENTS)

_BROWN = ("brown3", "brown3t2", "brown4", "brown4t2")

_FILM = 36.0
"""Millimetres across the frame that focal lengths are of."""


def recognises(folder: Path) -> bool:
    """Whether there is a CSV file with these columns, or an XMP file of the program."""
    return bool(_tables(folder) or _sidecars(folder))


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The cameras of the CSV file, or else of the XMP files, sorted by name; points of `points.ply`.

    Raises:
        InputError: several CSV files; a file is damaged; a lens that is not known here; a mask is missing.
    """
    table = only_one(folder, _tables(folder))
    entries, notes = _sidecar_entries(_sidecars(folder)) if table is None else _rows(table)
    frames = [_frame(folder, entry, wanted) for entry in entries]
    frames.sort(key=lambda frame: frame.name)
    return Listing(frames, points=points_beside(folder, frames) if frames else None, notes=notes)


def _frame(folder: Path, entry: Entry, wanted: Wanted) -> Frame:
    name, image = placed_image(folder, entry.text("name"), entry.path, wanted)
    size = size_of(image)
    longer = max(size)
    focal = entry.number("f") / _FILM * longer
    offset = entry.number("px", 0.0) * longer, entry.number("py", 0.0) * longer
    if "matrix" in entry.said:
        rotation, axes = entry.numbers("matrix", 9).reshape(3, 3).T, None
    else:
        rotation, axes = _turned(entry), OPENGL
    viewmat = entry.viewmat(rotation, entry.numbers("place", 3), axes)
    K = pinhole_of(focal, offset, size, fy=focal * entry.number("aspect", 1.0))
    mask = wanted.mask_of(folder, name, entry.path)
    return Frame(name, image, mask, viewmat, K, size, _lens(entry))


def _turned(entry: Entry) -> Float[Tensor, "3 3"]:
    """Camera to world, of heading, pitch and roll."""
    heading, pitch, roll = (math.radians(value) for value in entry.numbers("angles", 3).tolist())
    (ch, sh), (cp, sp), (cr, sr) = ((math.cos(angle), math.sin(angle)) for angle in (-heading, pitch, roll))
    about_z = torch.tensor([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]], dtype=torch.float64)
    about_x = torch.tensor([[1, 0, 0], [0, cp, -sp], [0, sp, cp]], dtype=torch.float64)
    about_y = torch.tensor([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]], dtype=torch.float64)
    return about_z @ about_x @ about_y


def _lens(entry: Entry) -> Lens | None:
    k1, k2, k3, k4, t1, t2 = (entry.number(key, 0.0) for key in _COEFFICIENTS)
    if not any((k1, k2, k3, k4, t1, t2)):
        return None
    model = entry.text("model", "brown3")
    if model not in _BROWN or k4 != 0:
        odd = f"{model:.40} distortion" if model not in _BROWN else "k4"
        raise entry.wrong(f"has {odd}, which is not read; align with Brown3, or export undistorted images")
    return brown_lens("lens distortion", k1, k2, k3, t2, t1)


def _tables(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("*.csv")) if set(_NEEDED) <= set(_columns(head_of(path)))]


def _columns(text: str) -> list[str]:
    """Of the first line that names them, by the names that they had first."""
    lines = [line for line in text.splitlines()[:5] if line.strip() and not line.startswith("#cameras ")]
    names = [name.strip().lstrip("#").lower() for name in lines[0].split(",")] if lines else []
    return [_NEWER.get(name, name) for name in names]


def _rows(path: Path) -> tuple[list[Entry], tuple[str, ...]]:
    """The cameras of a CSV file; notes name the columns that are not understood."""
    columns = _columns(head_of(path))
    text, entries = read_text(path, "utf-8-sig"), []
    try:
        for row in csv.reader(line for line in text.splitlines() if line.strip() and not line.startswith("#")):
            if len(row) < len(columns):
                raise InputError(
                    f"scene {path}: has a line of {len(row)} values for {len(columns)} columns; export it again"
                )
            said = {name: value.strip() for name, value in zip(columns, row, strict=False)}
            said["angles"] = " ".join(said[key] for key in ("heading", "pitch", "roll"))
            said["place"] = " ".join(said[key] for key in ("x", "y", "alt"))
            entries.append(Entry(path, f"camera {said['name']!r:.80}", said))
    except csv.Error as error:
        raise InputError(f"scene {path}: cannot be read ({error}); export it again") from error
    odd = [name for name in columns if name not in _KNOWN]
    return entries, (f"{path.name}: columns that are not read: {', '.join(odd)[:200]}",) if odd else ()


def _sidecars(folder: Path) -> list[Path]:
    places = [folder, folder / "images"]
    return [path for place in places for path in sorted(place.glob("*.xmp")) if "xcr:" in head_of(path)]


def _sidecar_entries(paths: list[Path]) -> tuple[list[Entry], tuple[str, ...]]:
    """The cameras of XMP files; those that say nothing of a pose are left out with a note."""
    found = [_sidecar(path) for path in paths]
    entries = [entry for entry in found if entry is not None]
    return entries, unplaced_note(len(found) - len(entries), len(found), "have XMP without a pose")


def _sidecar(path: Path) -> Entry | None:
    said: dict[str, str] = {}
    for element in read_xml(path).iter():
        texts = {element.tag: element.text or "", **element.attrib}
        said |= {key.rpartition("}")[2]: text.strip() for key, text in texts.items() if "capturingreality" in key}
    if "Position" not in said or "Rotation" not in said:
        return None
    entry = Entry(path, f"camera {path.stem!r:.80}", said)
    if said.get("Coordinates", "absolute") != "absolute":
        raise entry.wrong(f"has {said['Coordinates']:.40} coordinates; export absolute ones")
    if entry.number("Skew", 0.0) != 0:
        raise entry.wrong("has skew, which is not read; align without it")
    coefficients = entry.numbers("DistortionCoeficients", 6, [0.0] * 6).tolist()  # spelled so there
    return Entry(
        path, entry.name, {"name": path.stem, **_renamed(said), **dict(zip(_COEFFICIENTS, coefficients, strict=True))}
    )


def _renamed(said: Mapping[str, str]) -> dict[str, str]:
    """What XMP says, by the names that the columns of CSV have."""
    names = {"f": "FocalLength35mm", "px": "PrincipalPointU", "py": "PrincipalPointV", "aspect": "AspectRatio"}
    names |= {"matrix": "Rotation", "place": "Position", "model": "DistortionModel"}
    return {name: said[key] for name, key in names.items() if key in said}
