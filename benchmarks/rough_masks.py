"""Masks as networks make them, and objects that the frame cuts off: what they do to the hull that runs start from.

    python -m benchmarks.rough_masks FOLDERS --out SPOILT [--objects NAMES] [--kinds NAMES]
    python -m benchmarks.rough_masks FOLDERS --out SPOILT --runs RUNS [...]

Each capture is written anew for each kind, its training photos before a grey backdrop with spots, so that a mask with
a wrong border has wrong colours there; test photos stay as they are. Of each it is printed: photos left out; how
far off and how large, in percent of the clean capture's, the ball around the object is; and of the hull of preset
quick parts, holes, silhouette IoU on the test photos, exact Chamfer distance x 1e-3 to the true surface, CPU seconds.
With --runs whole runs are made instead, of photos 200 wide. Kinds, in pixels of photos 400 wide; where it says so only
some photos are spoilt:

    clean      before the backdrop, no more
    wider-2    the object grows by 2 pixels, in all photos; others likewise
    thinner-2  it shrinks by 2
    ragged     its outline wanders by up to 4 pixels, 2 in the mean of squares, otherwise in every photo
    blobs      one photo in ten has a disc that is none of the object's, or lacks one, as wide as a sixth of the photo
    network    ragged and blobs
    third      a third of the photos are cropped, through the object: a fifth to two fifths of its size is outside
    all        all are
    half       all are, always at the part of the object that is farthest along x: no photo shows that part
    gap        all, and the outermost two pixels of each mask are empty, as some networks leave them
"""

import argparse
import json
import math
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import distance_transform_edt, gaussian_filter

import etsplat
from benchmarks.starts import distance
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.photograph import normalize_mesh
from etsplat.data.photos import first_hits, photos_of
from etsplat.geometry.parts import shape_of
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source, make_subject
from etsplat.tasks.starting_hull import plain_hull
from studies.objects.subjects import SURFACE, find_subjects

WIDTH = 400
"""Of the photos in whose pixels the kinds are told."""

CUT = (0.2, 0.4)
"""How much of the object's size a crop leaves outside."""

HULL = ("left out", "off", "ball, %", "parts, holes", "IoU", "Chamfer")
RUN = ("parts, holes", "IoU", "PSNR of the mesh", "Chamfer", "verdict")
"""Columns of the tables."""

Mask = np.ndarray
Box = tuple[int, int, int, int]
"""Left, upper, right and lower end of what is kept of a photo."""


@dataclass(frozen=True)
class View:
    """A training photo that is to be spoilt.

    Attributes:
        inside: (H, W) its mask.
        number: of the photo.
        pixel: how many of its pixels are one of a photo 400 wide.
        farthest: (x, y) where in it the part of the object lies that kind `half` leaves outside.
        rng: of this photo.
    """

    inside: Mask
    number: int
    pixel: float
    farthest: tuple[float, float]
    rng: np.random.Generator


def signed(mask: Mask) -> np.ndarray:
    """Pixels to the outline, negative outside."""
    return np.asarray(distance_transform_edt(mask)) - np.asarray(distance_transform_edt(~mask))


def ragged(view: View, mask: Mask) -> Mask:
    noise = gaussian_filter(view.rng.standard_normal(mask.shape), 6 * view.pixel)
    return signed(mask) + view.pixel * (2 * noise / noise.std()).clip(-4, 4) > 0


def blobs(view: View, mask: Mask) -> Mask:
    """Discs beside the object and bites out of its outline in turn."""
    if view.number % 10 != 4:
        return mask
    height, width = mask.shape
    away = signed(mask)
    bite = view.number % 20 != 4
    rows, columns = np.nonzero(np.abs(away) < 2 if bite else away < -width / 8)
    chosen = view.rng.integers(len(rows))
    y, x = np.ogrid[:height, :width]
    disc = (y - rows[chosen]) ** 2 + (x - columns[chosen]) ** 2 < (width / 12) ** 2
    return mask & ~disc if bite else mask | disc


def gap(view: View, mask: Mask) -> Mask:
    edge = round(2 * view.pixel)
    inner = np.zeros_like(mask)
    inner[edge:-edge, edge:-edge] = True
    return mask & inner


def cut(view: View) -> Box:
    """Through the object, at a side by chance."""
    return _cut(view, int(view.rng.integers(4)))


def cut_third(view: View) -> Box:
    height, width = view.inside.shape
    return cut(view) if view.number % 3 == 1 else (0, 0, width, height)


def cut_half(view: View) -> Box:
    """At the side where the part lies that no photo is to show; nothing where it is in front or behind."""
    height, width = view.inside.shape
    rows, columns = np.nonzero(view.inside)
    x, y = (place - side.mean() for place, side in zip(view.farthest, (columns, rows), strict=True))
    side = (0 if x < 0 else 2) if abs(x) > abs(y) else (1 if y < 0 else 3)
    size = np.ptp(columns) if side % 2 == 0 else np.ptp(rows)
    return _cut(view, side) if max(abs(x), abs(y)) > 0.2 * size else (0, 0, width, height)


def _cut(view: View, side: int) -> Box:
    height, width = view.inside.shape
    rows, columns = np.nonzero(view.inside)
    part = view.rng.uniform(*CUT)
    box = [0, 0, width, height]
    lower, upper = ((columns.min(), columns.max()), (rows.min(), rows.max()))[side % 2]
    box[side] = round(lower + part * (upper - lower)) if side < 2 else round(upper - part * (upper - lower))
    return box[0], box[1], box[2], box[3]


def grown(pixels: float) -> Callable[[View, Mask], Mask]:
    return lambda view, mask: signed(mask) > -pixels * view.pixel


MASKS: dict[str, Callable[[View, Mask], Mask]] = {
    **{f"wider-{pixels}": grown(pixels) for pixels in (1, 2, 3, 4)},
    **{f"thinner-{pixels}": grown(-pixels) for pixels in (1, 2, 3, 4)},
    "ragged": ragged,
    "blobs": blobs,
    "network": lambda view, mask: blobs(view, ragged(view, mask)),
    "gap": gap,
}
CROPS: dict[str, Callable[[View], Box]] = {"third": cut_third, "all": cut, "half": cut_half, "gap": cut}
KINDS = ["clean", *dict.fromkeys([*MASKS, *CROPS])]


def backdrop(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) grey with spots."""
    spots = gaussian_filter(rng.standard_normal((height, width, 3)), (width / 50, width / 50, 0))
    return (0.5 + 0.12 * spots / spots.std()).clip(0, 1)


def write_spoilt(source: Path, out: Path, kind: str) -> None:
    """A capture with its training photos spoilt, and its test photos and true surface as they are."""
    shutil.rmtree(out, ignore_errors=True)
    (out / "train").mkdir(parents=True)
    for name in ("test", "transforms_test.json", SURFACE):
        if (path := source / name).is_dir():
            shutil.copytree(path, out / name)
        elif path.is_file():
            shutil.copy(path, out / name)
    document = json.loads((source / "transforms_train.json").read_text())
    frames = [_spoilt(source, out, kind, number, frame, document) for number, frame in enumerate(document["frames"])]
    (out / "transforms_train.json").write_text(json.dumps({"frames": frames}))


def _spoilt(source: Path, out: Path, kind: str, number: int, frame: dict[str, Any], document: Any) -> dict[str, Any]:
    picture = np.asarray(Image.open(source / f"{frame['file_path']}.png").convert("RGBA")) / 255
    height, width = picture.shape[:2]
    focal = width / 2 / math.tan(document["camera_angle_x"] / 2)
    toward = np.array(frame["transform_matrix"])[:3, :3].T @ [1, 0, 0]
    rng = np.random.default_rng([KINDS.index(kind), number])
    inside = picture[..., 3] >= 0.5
    middle = np.argwhere(inside).mean(axis=0)
    reach = 0.5 * inside.sum() ** 0.5
    farthest = middle[1] + reach * toward[0], middle[0] - reach * toward[1]
    view = View(inside, number, width / WIDTH, farthest, rng)
    alpha = picture[..., 3:]
    colors = alpha * picture[..., :3] + (1 - alpha) * backdrop(height, width, np.random.default_rng(number))
    left, upper, right, lower = CROPS[kind](view) if kind in CROPS else (0, 0, width, height)
    colors, alpha, mask = (each[upper:lower, left:right] for each in (colors, alpha[..., 0], inside))
    if kind in MASKS:
        alpha = MASKS[kind](view, mask).astype(float)
    pixels = np.concatenate([colors, alpha[..., None]], axis=2)
    Image.fromarray((255 * pixels).round().astype(np.uint8)).save(out / "train" / f"{number:03d}.png")
    camera = {"fl_x": focal, "cx": width / 2 - left, "cy": height / 2 - upper, "w": right - left, "h": lower - upper}
    return {"file_path": f"train/{number:03d}", "transform_matrix": frame["transform_matrix"], **camera}


def outline(views: Dataset, vertices: torch.Tensor, faces: torch.Tensor) -> float:
    """Silhouette IoU of a surface, mean over the test photos."""
    shared = []
    for photo in photos_of(replace(views, train=views.test, test=[])):
        drawn, mask = first_hits(photo, vertices, faces)[1] >= 0, photo.pixels[0, 3] > 0.5
        shared.append(float((drawn & mask).sum() / (drawn | mask).sum()))
    return float(np.mean(shared))


def row(name: str, source: Path, kind: str, truth: MeshFile, clean: Dataset | None) -> tuple[str, Dataset | None]:
    """Of the table; and the capture, in the frame that its masks give it, if there is a hull."""
    config, begun = ReconstructConfig.quick(), time.process_time()
    head = f"| {name} | {kind} |"
    try:
        loaded, _ = load_source(source, config)
        views, _ = make_subject(loaded, config, lambda *_: None, torch.device("cpu"))
        vertices, faces = plain_hull(views, config)[:2]
    except InputError as error:
        return f"{head} {error} |", None
    seconds, frame = time.process_time() - begun, views.normalization
    left_out = len(json.loads((source / "transforms_train.json").read_text())["frames"]) - len(views.train)
    left_out -= len(views.watched)
    right = frame if clean is None else clean.normalization
    off = float((frame.center - right.center).norm()) / right.radius
    found, size = shape_of(vertices, faces), frame.radius / right.radius
    return (
        f"{head} {left_out} | {100 * off:.1f} | {100 * size:.0f} | {found.parts}, {found.holes} | "
        f"{outline(views, vertices, faces):.3f} | "
        f"{1e3 * distance((vertices, faces), frame.apply(truth.vertices), truth.faces):.2f} | {seconds:.1f} |",
        views,
    )


def run_row(name: str, source: Path, kind: str, truth: MeshFile, out: Path, iterations: int) -> str:
    """Of the table of whole runs, made if it is not there yet."""
    config = ReconstructConfig.quick().changed({"iterations": iterations, "resolution": 200, "max_faces": 12_000})
    head, begun = f"| {name} | {kind} |", time.process_time()
    if not (out / "metrics.json").is_file():
        try:
            etsplat.reconstruct(source, out, config, overwrite=True)
        except InputError as error:
            return f"{head} {error} |"
    metrics = json.loads((out / "metrics.json").read_text())
    judged = metrics["judgement"]
    mesh = load_mesh(out / "mesh.ply")
    frame = normalize_mesh(truth)[1]
    ours, wanted = (frame.apply(each.vertices) for each in (mesh, truth))
    return (
        f"{head} {judged['parts']}, {judged['holes']} | {metrics['silhouette_iou']:.3f} | {metrics['psnr_mesh']:.2f} | "
        f"{1e3 * distance((ours, mesh.faces), wanted, truth.faces):.2f} | {judged['verdict']} | "
        f"{time.process_time() - begun:.0f} |"
    )


def main() -> None:
    """Writes what is not there yet, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--objects", nargs="*", default=())
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    parser.add_argument("--runs", type=Path, help="folder for whole runs of photos 200 wide, in the place of hulls")
    parser.add_argument("--iterations", type=int, default=1000)
    options = parser.parse_args()
    columns = ["object", "masks", *(HULL if options.runs is None else RUN), "CPU s"]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|", flush=True)
    for subject in find_subjects(options.inputs, options.objects):
        if subject.surface is None:
            raise SystemExit(f"{subject.name}: its surface is not known")
        clean = None
        for kind in options.kinds:
            out = options.out / f"{subject.name}-{kind}"
            if not out.is_dir():
                write_spoilt(subject.source, out, kind)
            truth = load_mesh(subject.surface)
            if options.runs is not None:
                print(run_row(subject.name, out, kind, truth, options.runs / out.name, options.iterations), flush=True)
                continue
            with torch.no_grad():
                line, views = row(subject.name, out, kind, truth, clean)
            print(line, flush=True)
            clean = views if kind == "clean" else clean


if __name__ == "__main__":
    main()
