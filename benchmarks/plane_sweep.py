"""A dense cloud of a capture by a plane sweep, as multi-view stereo would make one: a start for `train --init-points`.

python -m benchmarks.plane_sweep data/scenes/fountain-P11 --width 300 --out fountain.ply

Each training photo is compared, at planes in front of it, with the photos that see most of the same points from another
side: correlation of small windows, of those that look most alike, since others may not see the place. What depths of
other photos agree with becomes a point with normal and colour, in a PLY with the fields of COLMAP's `fused.ply`.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, normalize

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.depth_points import project
from etsplat.data.load import load_dataset
from etsplat.data.pictures import as_float
from etsplat.io.ply_tables import encode_ply

NEIGHBOURS, ANGLES = 4, (2.0, 40.0)
"""Photos that one is compared with, and degrees between their lines of sight to a point that both have in the frame."""

PLANES, BEYOND = 128, 1.2
"""Depths that are tried, evenly by their inverses, to this factor beyond the points that a photo shows."""

WINDOW, SAYING = 7, 2
"""Pixels along a window's side, and how many of the neighbours, those that look most alike, are asked at each depth."""

ALIKE, AGREE, AGREEING = 0.7, 0.01, 2
"""Least correlation; how near depths are that agree, relative to them; and of how many neighbours they must be."""

FLAT = 1e-5
"""Variance of grey in a window that shows nothing to compare."""

_PLACES, _COLORS = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")


class Sweep:
    """Depths of the training photos of a capture.

    Attributes:
        near: of each photo, by its index, those that it is compared with.
        maps: of each that has such, the depth of every pixel and how alike the others look there.
    """

    def __init__(self, dataset: Dataset) -> None:
        """Takes a capture with points, which say at which depths to look and which photos see the same."""
        if dataset.exact_points is None:
            raise InputError("points: the capture has none, which say at which depths to look")
        self._dataset, self._points = dataset, dataset.exact_points
        self._grey = {view: as_float(dataset.images[view])[..., :3].mean(dim=2) for view in dataset.train}
        self.near = {view: self._neighbours(view) for view in dataset.train}
        self.maps = {view: self._swept(view) for view in dataset.train if self.near[view]}

    def agreed(self, view: int) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
        """Where each pixel's depth puts it, and whether others look alike there and their depths agree."""
        depth, alike = self.maps[view]
        viewmat, sights = self._dataset.viewmats[view], _sights(self._dataset, view)
        points = (sights * depth[..., None].double() - viewmat[:3, 3]) @ viewmat[:3, :3]
        agreeing = torch.zeros(depth.shape)
        for other in self.near[view]:
            if other in self.maps:
                inside, far, x, y = _framed(self._dataset, other, points.reshape(-1, 3))
                said, score = (_sampled(of, x, y, "nearest") for of in self.maps[other])
                same = inside & (score > ALIKE) & ((said - far).abs() < AGREE * far)
                agreeing += same.reshape(depth.shape)
        return points, (alike > ALIKE) & (agreeing >= AGREEING)

    def cloud(self) -> np.ndarray:
        """The table of a PLY file, in the capture's own units."""
        kind = [*((name, "f4") for name in _PLACES), *((name, "u1") for name in _COLORS)]
        tables = []
        for view in self.maps:
            points, kept = self.agreed(view)
            kept[[0, -1]], kept[:, [0, -1]] = False, False
            normals = torch.zeros_like(points)
            across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
            normals[1:-1, 1:-1] = normalize(torch.linalg.cross(down, across), dim=2)
            places = torch.cat([self._dataset.normalization.invert(points[kept]), normals[kept]], dim=1)
            colors = 255 * as_float(self._dataset.images[view])[..., :3][kept]
            table = np.empty(len(places), kind)
            for name, column in zip(_PLACES + _COLORS, torch.cat([places, colors.round()], dim=1).T, strict=True):
                table[name] = column.numpy()
            tables.append(table)
        return np.concatenate(tables)

    def _neighbours(self, view: int) -> list[int]:
        """The photos with most of a photo's points in their frames, seen from elsewhere but not too far away."""
        points = self._points[_framed(self._dataset, view, self._points)[0]]
        own, counts = normalize(points - self._dataset.centers[view], dim=1), {}
        for other in self._dataset.train:
            sight = normalize(points - self._dataset.centers[other], dim=1)
            angle = (own * sight).sum(dim=1).clamp(-1, 1).acos().rad2deg()
            seen = _framed(self._dataset, other, points)[0] & (angle > ANGLES[0]) & (angle < ANGLES[1])
            counts[other] = int(seen.sum())
        return [other for other in sorted(counts, key=lambda other: -counts[other]) if counts[other]][:NEIGHBOURS]

    def _swept(self, view: int) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
        """The depth of each pixel at which others look most like it, between planes; -1 for how alike at the ends."""
        inside, depths, _, _ = _framed(self._dataset, view, self._points)
        depths = depths[inside]
        inverse = torch.linspace(float(1 / (BEYOND * depths.max())), float(BEYOND / depths.min()), PLANES)
        lines = [self._lines(view, other) for other in self.near[view]]
        scores = torch.stack([self._score(view, 1 / float(step), lines) for step in inverse])
        best = scores.argmax(dim=0)
        middle = best.clamp(1, PLANES - 2)
        left, here, right = (scores.gather(0, (middle + step)[None])[0] for step in (-1, 0, 1))
        bend = (2 * here - left - right).clamp(min=1e-6)
        shift = (0.5 * (right - left) / bend).clamp(-0.5, 0.5)
        depth = 1 / (inverse[0] + (middle + shift) * (inverse[1] - inverse[0]))
        return depth, torch.where(best == middle, here, -1.0)

    def _lines(self, view: int, other: int) -> tuple[int, Float[Tensor, "H W 3"], Float[Tensor, " 3"]]:
        """Another photo; and what, times a depth, and added, is where it has a photo's pixel of that depth."""
        change = self._dataset.viewmats[other] @ torch.linalg.inv(self._dataset.viewmats[view])
        K = self._dataset.Ks[other]
        along = _sights(self._dataset, view) @ (K @ change[:3, :3]).T
        return other, along.float(), (K @ change[:3, 3]).float()

    def _score(self, view: int, depth: float, lines: list[tuple[int, Tensor, Tensor]]) -> Float[Tensor, "H W"]:
        """How alike others look if all of a photo is at one depth."""
        alike = []
        for other, along, start in lines:
            x, y, z = (depth * along + start).unbind(dim=2)
            height, width = self._grey[other].shape
            inside = (z > 0) & (x > 0) & (x < width * z) & (y > 0) & (y < height * z)
            z = torch.where(inside, z, 1.0)
            shown = _sampled(self._grey[other], x / z, y / z, "bilinear")
            alike.append(torch.where(inside, correlation(self._grey[view], shown), -1.0))
        return torch.stack(alike).sort(dim=0, descending=True).values[:SAYING].mean(dim=0)


def correlation(one: Float[Tensor, "H W"], other: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Of the windows around each pixel of two pictures; -1 where one of them shows nothing to compare."""
    planes = torch.stack([one, other, one * one, other * other, one * other])[None]
    a, b, aa, bb, ab = avg_pool2d(planes, WINDOW, 1, WINDOW // 2, count_include_pad=False)[0]
    var_a, var_b = aa - a * a, bb - b * b
    found = (ab - a * b) / (var_a * var_b).clamp(min=FLAT**2).sqrt()
    return torch.where((var_a > FLAT) & (var_b > FLAT), found, -1.0)


def _framed(
    dataset: Dataset, view: int, points: Float[Tensor, "P 3"]
) -> tuple[Bool[Tensor, " P"], Tensor, Tensor, Tensor]:
    """Which points are in a photo's frame; their depths, columns and rows."""
    (depth, x, y), (width, height) = project(dataset, view, points), dataset.images.sizes[view]
    return (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height), depth, x, y


def _sights(dataset: Dataset, view: int) -> Float[Tensor, "H W 3"]:
    """From the camera through each pixel, to depth 1, along the camera's axes."""
    width, height = dataset.images.sizes[view]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], dim=2).double() @ torch.linalg.inv(dataset.Ks[view]).T


def _sampled(picture: Float[Tensor, "H W"], x: Tensor, y: Tensor, mode: str) -> Tensor:
    """A picture at columns and rows."""
    height, width = picture.shape
    places = torch.stack([2 * x / width - 1, 2 * y / height - 1], dim=-1).to(picture).reshape(1, 1, -1, 2)
    found = grid_sample(picture[None, None], places, mode=mode, align_corners=False, padding_mode="border")
    return found.reshape(x.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--width", type=int, default=300)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    table = Sweep(load_dataset(options.capture, width=options.width)).cloud()
    options.out.write_bytes(encode_ply({"vertex": table}))
    print(f"{len(table):,} points in {options.out}")


if __name__ == "__main__":
    main()
