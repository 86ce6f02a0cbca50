"""What hangs in the air of trained scenes: PSNR by cameras off the path of the photos, where the truth is known.

    python -m benchmarks.floaters runs/floaters ring few side rough --set loss.lambda_opacity=0.02 asset=false

Trains the demo's scene, which can be photographed from anywhere, from the photos that each name stands for:

    ring    all 36 training photos of `demo:scene`
    few     every fourth of them
    side    those of a third of the way round
    rough   all, by cameras that are a tenth of a degree off, with lenses that darken the corners

and gives a row of a table in Markdown for each: the mean PSNR of the held-out photos, and of pictures by cameras moved
off the path, sideways, up, and nearer by fractions of the distance to what they look at, which stays in their middle;
of the soft soup and of the opaque mesh. Off the path pixels count whose surface point some training photo shows, and
views in which at least half of the pixels do.
"""

import argparse
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Bool, Float
from torch import Tensor

import etsplat
from etsplat.core.cameras import Cameras, look_at
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_photo, demo_scene, demo_surface
from etsplat.data.pictures import StoredPictures
from etsplat.metrics.image import psnr
from etsplat.model.model import Model
from etsplat.model.solid_soup import SolidSoup

UP = torch.tensor([0.0, 1.0, 0.0])

MOVES: dict[str, tuple[float, float, float]] = {
    "sideways 1/4": (0.25, 0.0, 0.0),
    "sideways -1/4": (-0.25, 0.0, 0.0),
    "up 1/4": (0.0, 0.25, 0.0),
    "nearer 1/4": (0.0, 0.0, 0.25),
    "nearer 1/2": (0.0, 0.0, 0.5),
}
"""How cameras are moved: to the right, up and towards what they look at, in units of its distance."""

SAME_DEPTH, COUNTED = 0.02, 0.5
"""How much deeper, relatively, than what a photo shows a point may be that it shows too; and the least share of pixels
that count."""

POSE_NOISE, VIGNETTE = math.radians(0.1), 0.25
"""Of `rough`: standard deviation of the turns about each axis; how much darker a photo's corners are than its middle,
at the same mean brightness."""


def few(capture: Dataset) -> Dataset:
    """Every fourth training photo."""
    return replace(capture, train=capture.train[::4])


def side(capture: Dataset) -> Dataset:
    """The photos, held-out ones too, whose cameras stand within 60 degrees of +z, seen from the middle."""
    towards = capture.centers[:, [0, 2]]
    near = towards[:, 1] > 0.5 * towards.norm(dim=1)
    return replace(capture, train=_where(near, capture.train), test=_where(near, capture.test))


def rough(capture: Dataset) -> Dataset:
    """Training photos by cameras that are slightly off, through lenses that darken the corners."""
    turns = POSE_NOISE * torch.randn(len(capture), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    viewmats, photos = capture.viewmats.clone(), [capture.images[index] for index in range(len(capture))]
    for index in capture.train:
        axis = torch.zeros(4, 4, dtype=torch.float64)
        axis[[2, 0, 1], [1, 2, 0]], axis[[1, 2, 0], [2, 0, 1]] = turns[index], -turns[index]
        viewmats[index] = torch.linalg.matrix_exp(axis) @ viewmats[index]
        height, width = photos[index].shape[:2]
        y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        light = 1 + VIGNETTE * (1 / 3 - (x**2 + y**2) / 2)
        photos[index] = (photos[index] * light[..., None] + 0.5).clamp(0, 255).to(torch.uint8)
    return replace(capture, viewmats=viewmats, images=StoredPictures(photos))


SCENES: dict[str, Callable[[Dataset], Dataset]] = {
    "ring": lambda whole: whole,
    "few": few,
    "side": side,
    "rough": rough,
}


@dataclass(frozen=True)
class OffPath:
    """A picture that nobody took: its camera, the truth (H, W, 3), and the pixels whose surface some photo shows."""

    camera: Cameras
    truth: Float[Tensor, "H W 3"]
    counts: Bool[Tensor, "H W"]


def off_path(capture: Dataset, move: tuple[float, float, float]) -> Iterator[OffPath]:
    """The held-out cameras of a capture of the demo's scene, moved; those that see enough of what photos show."""
    vertices, colors = demo_surface()
    shown = [_depth(vertices, capture.cameras[index]) for index in capture.train]
    for index in capture.test:
        camera = _moved(vertices, capture.cameras[index], move)
        points = _unprojected(camera, _depth(vertices, camera))
        counts = torch.zeros(points.shape[:2], dtype=torch.bool)
        for view, depth in zip(capture.train, shown, strict=True):
            counts |= _shows(capture.cameras[view], depth, points)
        if float(counts.float().mean()) >= COUNTED:
            yield OffPath(camera, demo_photo(vertices, colors, camera).float() / 255, counts)


def scores(model: Model, capture: Dataset, *, opaque: bool) -> dict[str, float]:
    """Mean PSNR of the held-out photos, "held out", and of each move, by its name."""

    def drawn(camera: Cameras) -> Float[Tensor, "H W 3"]:
        picture = model.render_opaque(camera)[0, ..., :3] if opaque else model.render(camera).color[0]
        return picture.clamp(0, 1)

    with torch.no_grad():
        photos = [(capture.cameras[index], capture.images[index].float() / 255) for index in capture.test]
        found = {"held out": fmean(psnr(drawn(camera), photo) for camera, photo in photos)}
        for name, move in MOVES.items():
            views = [psnr(drawn(v.camera)[v.counts][None], v.truth[v.counts][None]) for v in off_path(capture, move)]
            found[name] = fmean(views) if views else math.nan
    return found


def run(name: str, out: Path, config: etsplat.TrainConfig, width: int) -> list[tuple[str, dict[str, float]]]:
    """Trains a scene and measures what came of it: the soup, and the mesh if there is one."""
    capture = SCENES[name](demo_scene(width, 3 * width // 4))
    result = etsplat.train(capture, out, config, callbacks=[lambda event: None], overwrite=True)
    rows = [(f"{name}, soft soup, {len(result.soup):,}", scores(result.soup, capture, opaque=False))]
    if result.opaque is not None:
        solid = SolidSoup.of(result.opaque, result.soup)
        rows.append((f"{name}, opaque mesh, {len(solid):,}", scores(solid, capture, opaque=True)))
    return rows


def _where(chosen: Bool[Tensor, " B"], views: list[int]) -> list[int]:
    return [view for view in views if bool(chosen[view])]


def _moved(vertices: Tensor, camera: Cameras, move: tuple[float, float, float]) -> Cameras:
    """Looks at the same point of the surface."""
    depth = float(_depth(vertices, camera)[camera.height // 2, camera.width // 2])
    right, _, forward = camera.viewmats[0, :3, :3].unbind()
    center = camera.centers[0]
    eye = center + depth * (move[0] * right + move[1] * UP + move[2] * forward)
    return replace(camera, viewmats=look_at(eye, center + depth * forward, UP)[None])


def _depth(vertices: Tensor, camera: Cameras) -> Float[Tensor, "H W"]:
    depth = etsplat.rasterize_opaque(vertices, cameras=camera).depth
    assert depth is not None
    return depth[0, ..., 0]


def _unprojected(camera: Cameras, depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    height, width = depth.shape
    row, column = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([column, row, torch.ones_like(row)], dim=-1) @ torch.linalg.inv(camera.Ks[0]).T
    rotation, shift = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    return (depth[..., None] * rays - shift) @ rotation


def _shows(camera: Cameras, depth: Float[Tensor, "H W"], points: Float[Tensor, "H W 3"]) -> Bool[Tensor, "H W"]:
    """Which points a photo shows: in its frame, and not behind what is nearest there."""
    local = points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    pixels = local @ camera.Ks[0].T
    column, row = (pixels[..., axis] / local[..., 2] for axis in (0, 1))
    inside = (local[..., 2] > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    nearest = depth[row.long().clamp(0, camera.height - 1), column.long().clamp(0, camera.width - 1)]
    return inside & (local[..., 2] <= (1 + SAME_DEPTH) * nearest)


def _value(text: str) -> object:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def main(arguments: list[str] | None = None) -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for the runs")
    parser.add_argument("scenes", nargs="+", choices=SCENES)
    parser.add_argument("--width", type=int, default=200, help="of the photos, in pixels")
    parser.add_argument("--set", nargs="*", default=[], metavar="SETTING=VALUE", help="besides preset quick")
    options = parser.parse_args(arguments)
    changes = {name: _value(text) for name, text in (each.split("=", 1) for each in options.set)}
    config = etsplat.TrainConfig.quick().changed(changes)
    names = ["held out", *MOVES]
    print("| scene, what is drawn, triangles | " + " | ".join(names) + " |\n" + "|---" * (len(names) + 1) + "|")
    for scene in options.scenes:
        for title, found in run(scene, options.out / scene, config, options.width):
            print(f"| {title} | " + " | ".join(f"{found[name]:.2f}" for name in names) + " |", flush=True)


if __name__ == "__main__":
    main()
