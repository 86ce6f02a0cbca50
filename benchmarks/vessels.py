"""Vessels by formula, photographed: where runs start in their hollows, painted, with masks that are rough, and white.

    python -m benchmarks.vessels --out FOLDER [--vessels NAMES] [--kinds right rough white] [--runs]

Writes FOLDER/NAME.ply, painted, and FOLDER/white/NAME.ply, and photographs each as preset quick photographs a mesh.
Rough masks have an outline that wanders by up to 1.6 pixels, 0.8 in the mean of squares, otherwise in every photo, and
beside the object they show a backdrop with spots. Of each it is printed: by what the hull was cut open; faces; holes of
each part, and of the true surface; exact Chamfer distance x 1e-3 of 20,000 samples; CPU seconds of the start. Of
`dimple`, `drum`, `sofa` and `table` nothing is hollow between walls. With --runs there are whole runs instead, of kinds
whose masks are right: the same of their results.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.ndimage import gaussian_filter

import etsplat
from benchmarks.rough_masks import backdrop, signed
from benchmarks.starts import distance
from etsplat.data.dataset import Dataset
from etsplat.data.meshing import SignedDistance, dual_contour
from etsplat.data.pictures import StoredPictures, as_float
from etsplat.geometry.parts import genera
from etsplat.io.mesh_files import load_mesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source, make_subject
from etsplat.tasks.starts import make_start

CELLS, REACH = 200, 1.3
"""Of the grid that a vessel is contoured in, and half of its side."""

WANDERS = 0.8
"""Pixels, in the mean of squares."""

KINDS = ("right", "rough", "white")

Along = Callable[[np.ndarray], np.ndarray]
"""A radius by height."""


def turned(outer: Along, inner: Along, bottom: float, top: float, floor: float) -> SignedDistance:
    """A vessel around the y axis."""

    def shape(places: np.ndarray) -> np.ndarray:
        x, y, z = places.T
        out = np.hypot(x, z)
        solid = np.maximum(out - outer(y), np.maximum(y - top, bottom - y))
        return np.maximum(solid, -np.maximum(out - inner(y), floor - y))

    return shape


def thick(outer: Along, wall: float, bottom: float, top: float, floor: float) -> SignedDistance:
    """The same with walls of one thickness."""
    return turned(outer, lambda y: outer(y) - wall, bottom, top, floor)


def box(x: float, y: float, z: float, middle: tuple[float, float, float] = (0, 0, 0)) -> SignedDistance:
    """Half sides and middle."""
    return lambda places: (np.abs(places - np.array(middle)) - np.array([x, y, z])).max(axis=1)


def handle(x: float, y: float, radius: float, width: float, inside: float) -> SignedDistance:
    """A ring upright at a side, of which what is nearer to the axis than `inside` is left out."""
    side = np.sign(x)

    def shape(places: np.ndarray) -> np.ndarray:
        ring = np.hypot(np.hypot(places[:, 0] - x, places[:, 1] - y) - radius, places[:, 2]) - width
        return np.maximum(ring, inside - side * places[:, 0])

    return shape


def joined(*shapes: SignedDistance) -> SignedDistance:
    return lambda places: np.stack([shape(places) for shape in shapes]).min(axis=0)


def without(shape: SignedDistance, *holes: SignedDistance) -> SignedDistance:
    return lambda places: np.maximum(shape(places), -joined(*holes)(places))


def placed(shape: SignedDistance, matrix: list[list[float]]) -> SignedDistance:
    """A shape of which a matrix leads back to its own axes."""
    return lambda places: shape(places @ np.array(matrix).T)


def ball(y: float, radius: float) -> SignedDistance:
    return lambda places: np.linalg.norm(places - np.array([0, y, 0]), axis=1) - radius


def oval(x: float, z: float, bottom: float, top: float) -> SignedDistance:
    def shape(places: np.ndarray) -> np.ndarray:
        out = (np.hypot(places[:, 0] / x, places[:, 2] / z) - 1) * min(x, z)
        return np.maximum(out, np.maximum(places[:, 1] - top, bottom - places[:, 1]))

    return shape


def dish(places: np.ndarray) -> np.ndarray:
    x, y, z = places.T
    out = np.hypot(x, z)
    return np.maximum(np.abs(y + 0.42 - 0.12 * out * out) - 0.05, out - 0.95)


def trough(places: np.ndarray) -> np.ndarray:
    x, y, z = places.T
    out = np.abs(np.hypot(x, z) - 0.65)
    return np.maximum(np.maximum(out - 0.3, np.abs(y) - 0.3), -np.maximum(out - 0.22, -0.22 - y))


def windows(places: np.ndarray) -> np.ndarray:
    """Ten around, through walls."""
    x, y, z = places.T
    turn = np.arctan2(z, x) * 5 / np.pi
    return np.maximum(np.hypot(np.abs(turn - turn.round()) * np.pi / 5 * 0.6, y - 0.05) - 0.09, 0.4 - np.hypot(x, z))


CUP = thick(lambda y: 0.55 + 0 * y, 0.08, -0.7, 0.7, -0.6)
TANK = without(box(0.9, 0.45, 0.5), box(0.8, 0.45, 0.4, (0, 0.1, 0)))
LEGS = joined(*(box(0.08, 0.55, 0.08, (x, -0.05, z)) for x in (-0.75, 0.75) for z in (-0.45, 0.45)))
VESSELS: dict[str, SignedDistance] = {
    "ashtray": turned(lambda y: 0.85 + 0 * y, lambda y: 0.55 + 0.1 * y, -0.25, 0.25, -0.15),
    "basket": without(thick(lambda y: 0.6 + 0.12 * y, 0.08, -0.5, 0.5, -0.42), windows),
    "bath": without(oval(0.95, 0.55, -0.35, 0.35), oval(0.8, 0.42, -0.2, 0.5)),
    "bowl": without(ball(0, 0.9), ball(0, 0.8), box(2, 1, 2, (0, 1, 0))),
    "bucket": turned(lambda y: 0.55 + 0.2 * y, lambda y: 0.48 + 0.2 * y, -0.7, 0.6, -0.62),
    "cone": thick(lambda y: 0.12 + 0.35 * (y + 0.8), 0.07, -0.8, 0.8, -0.5),
    "cup": CUP,
    "dimple": without(ball(0, 0.8), ball(0.9, 0.6)),
    "divided": joined(TANK, box(0.05, 0.43, 0.45)),
    "drum": turned(lambda y: 0.6 + 0 * y, lambda y: -1 + 0 * y, -0.5, 0.5, 0),
    "jug": joined(
        thick(lambda y: 0.5 + 0.12 * np.sin(3 * y - 0.8), 0.08, -0.8, 0.8, -0.7), handle(0.6, 0.15, 0.35, 0.06, 0.46)
    ),
    "mortar": turned(lambda y: 0.6 + 0 * y, lambda y: 0.35 + 0 * y, -0.8, 0.8, -0.6),
    "mug": joined(CUP, handle(0.65, 0, 0.32, 0.07, 0.5)),
    "oval": placed(thick(lambda y: 0.62 + 0.15 * y, 0.08, -0.5, 0.5, -0.42), [[0.7, 0, 0], [0, 1, 0], [0, 0, 1.25]]),
    "planter": TANK,
    "pot": joined(
        turned(lambda y: 0.8 + 0 * y, lambda y: 0.7 + 0 * y, -0.45, 0.45, -0.35),
        handle(0.85, 0.1, 0.18, 0.06, 0.72),
        handle(-0.85, 0.1, 0.18, 0.06, 0.72),
    ),
    "saucer": joined(
        thick(lambda y: 0.42 + 0.1 * y, 0.06, -0.4, 0.3, -0.33), handle(0.48, -0.02, 0.2, 0.045, 0.38), dish
    ),
    "sofa": joined(
        box(0.9, 0.2, 0.45, (0, -0.35, 0)),
        box(0.9, 0.55, 0.1, (0, 0, -0.35)),
        *(box(0.1, 0.35, 0.45, (x, -0.2, 0)) for x in (-0.8, 0.8)),
    ),
    "table": joined(box(0.9, 0.06, 0.6, (0, 0.5, 0)), LEGS),
    "tilted": placed(CUP, [[np.cos(0.7), np.sin(0.7), 0], [-np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]]),
    "trough": trough,
    "vase": thick(lambda y: 0.42 + 0.22 * np.cos(2.6 * (y + 0.25)), 0.09, -0.9, 0.9, -0.8),
}


def waves(vertices: np.ndarray, seed: int, amplitudes: tuple[float, float, float, float]) -> np.ndarray:
    """(V, 3) colours around 0, of six waves of each of four lengths, that no two sides of a thing have alike."""
    rng, colors = np.random.default_rng(seed), np.zeros((len(vertices), 3))
    for frequency, amplitude in zip((3, 7, 16, 34), amplitudes, strict=True):
        for _ in range(6):
            along = vertices @ (frequency * rng.normal(size=3))
            colors += amplitude * np.sin(along[:, None] + rng.uniform(0, 2 * np.pi, 3)) * rng.normal(size=3)
    return colors


def write_vessel(name: str, out: Path, kind: str) -> Path:
    """Its mesh: white, or painted with waves of four lengths that no two of its sides have alike."""
    vertices, faces = dual_contour(VESSELS[name], (-REACH,) * 3, 2 * REACH / CELLS, (CELLS,) * 3)
    if kind == "white":
        (out / kind).mkdir(exist_ok=True)
        trimesh.Trimesh(vertices, faces, process=False).export(out / kind / f"{name}.ply")
        return out / kind / f"{name}.ply"
    colors = 0.5 + waves(vertices, list(VESSELS).index(name), (0.07, 0.054, 0.043, 0.036))
    mesh = trimesh.Trimesh(
        vertices, faces, process=False, vertex_colors=(255 * colors.clip(0.03, 0.97)).astype(np.uint8)
    )
    mesh.export(out / f"{name}.ply")
    return out / f"{name}.ply"


def roughened(views: Dataset) -> Dataset:
    """Views whose masks wander, before a backdrop."""
    rng, images = np.random.default_rng(7), []
    for stored in views.images:
        image = as_float(stored).numpy()
        noise = gaussian_filter(rng.standard_normal(image.shape[:2]), 6)
        wander = WANDERS * (noise / noise.std()).clip(-2, 2)
        mask = (signed(image[..., 3] > 0.5) + wander > 0)[..., None]
        colors = image[..., :3] + (1 - image[..., 3:]) * backdrop(*image.shape[:2], rng)
        images.append(torch.from_numpy(np.concatenate([colors * mask, mask], axis=2).astype(np.float32)))
    return replace(views, images=StoredPictures(images))


def start_row(path: Path, kind: str) -> tuple[object, ...]:
    config = ReconstructConfig.quick()
    views, _ = make_subject(load_source(path, config)[0], config, lambda *_: None, torch.device("cpu"))
    views = roughened(views) if kind == "rough" else views
    begun = time.process_time()
    started = make_start(None, views, config)
    seconds = time.process_time() - begun
    vertices, faces = started.mesh.surface()
    truth = load_mesh(path)
    score = distance((vertices.detach(), faces), views.normalization.apply(truth.vertices), truth.faces)
    holes = holes_of(vertices, faces), holes_of(truth.vertices, truth.faces)
    return path.stem, kind, started.cut or "-", f"{len(faces):,}", *holes, f"{1e3 * score:.3f}", f"{seconds:.0f}"


def run_row(path: Path, kind: str) -> tuple[object, ...]:
    begun = time.process_time()
    result = etsplat.reconstruct(path, path.parent / "runs" / path.stem, ReconstructConfig.quick(), overwrite=True)
    seconds, scores, truth = time.process_time() - begun, result.metrics, load_mesh(path)
    holes = holes_of(result.mesh.vertices, result.mesh.faces), holes_of(truth.vertices, truth.faces)
    numbers = f"{1e3 * scores['chamfer_exact']:.3f}", f"{scores['psnr_mesh']:.1f}", f"{seconds:.0f}"
    return path.stem, kind, result.verdict.split(":")[0], *holes, *numbers


def holes_of(vertices: torch.Tensor, faces: torch.Tensor) -> str:
    """Of each part."""
    return ", ".join(str(each) for each in genera(faces, len(vertices)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--vessels", nargs="*", default=[*VESSELS], choices=[*VESSELS])
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--runs", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    start = ("vessel", "kind", "cut by", "faces", "holes", "true", "Chamfer", "CPU s")
    titles = (
        ("vessel", "kind", "verdict", "holes", "true", "Chamfer", "PSNR of the mesh", "CPU s")
        if options.runs
        else start
    )
    print(f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}", flush=True)
    for name in options.vessels:
        for kind in options.kinds:
            if options.runs and kind == "rough":
                continue
            path = write_vessel(name, options.out, kind)
            row = run_row(path, kind) if options.runs else start_row(path, kind)
            print(f"| {' | '.join(str(each) for each in row)} |", flush=True)


if __name__ == "__main__":
    main()
