"""Where the error of the test views of a capture's opaque mesh comes from.

    python -m benchmarks.opaque_errors data/fountain-P11 --soups runs/soups

Arguments, soup and mesh are those of `benchmarks.opaque_mesh`. A table in Markdown, of the antialiased pictures that
the mesh is fitted by: PSNR of training and test views; how many training photos show the triangle that the centre of a
pixel of the test views sees, as % of the pixels / % of the squared error; and what training photos show of the point
that it sees, where two or more do: their standard deviation, as dB, and the PSNR of their mean beside the mesh's own.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from benchmarks.opaque_mesh import fitted, start
from benchmarks.tables import Table
from etsplat.core.rasterization import Rasterization
from etsplat.data.dataset import Dataset
from etsplat.data.photos import Photo
from etsplat.data.pictures import as_float
from etsplat.metrics.image import psnr
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.seen import Seen
from etsplat.tasks.soup_trainer import background_of

SHOWN = {"none": (0, 0), "one": (1, 1), "two to four": (2, 4), "five and more": (5, None)}
"""Ranges of how many photos show a triangle."""

SAME = 0.02
"""A photo shows a point whose depth differs by less than this share from that of the mesh there."""

WHOLE = 0.999
"""Least weight of pixels that count among those that a colour is interpolated from."""


@dataclass
class Shares:
    """Of pixels and squared error, by how many photos show what a pixel shows; -1 where it shows nothing."""

    pixels: list[Tensor] = field(default_factory=list)
    errors: list[Tensor] = field(default_factory=list)

    def text(self, least: int, most: int | None) -> str:
        """Of one range, in percent."""
        photos, error = torch.cat(self.pixels), torch.cat(self.errors)
        chosen = (photos >= least) & (photos <= (photos.max() if most is None else most))
        return f"{100 * chosen.double().mean():.1f} / {100 * error[chosen].sum() / error.sum():.1f}"


def nearest(mesh: TriangleMesh, capture: Dataset, view: int) -> Rasterization:
    """What a view sees at the centres of its pixels."""
    return rasterize_opaque(mesh.vertices.detach(), faces=mesh.faces, cameras=capture.cameras[view])


def photos_showing(mesh: TriangleMesh, training: list[Rasterization]) -> Tensor:
    """(F + 1) photos that show each triangle; the last row, of no triangle, is -1."""
    counts = torch.zeros(mesh.count + 1, dtype=torch.long)
    for drawn in training:
        assert drawn.triangle is not None
        counts[drawn.triangle.long().unique()] += 1
    counts[-1] = -1
    return counts


def points_seen(mesh: TriangleMesh, drawn: Rasterization) -> Tensor:
    """(H W, 3) points of the mesh at the pixels' centres; any where there is no triangle."""
    assert drawn.triangle is not None
    assert drawn.barycentrics is not None
    corners = mesh.vertices.detach()[mesh.faces[drawn.triangle.flatten().long()]]
    return (drawn.barycentrics.reshape(-1, 3, 1) * corners).sum(dim=1)


def photo_of(seen: Seen, capture: Dataset, view: int) -> Photo:
    """A photo over the background, with the weights of its pixels in a fourth plane."""
    mask, camera = capture.images.picture(view).mask, capture.cameras[view]
    counts = torch.ones_like(seen.photo[..., 0]) if mask is None else as_float(mask)
    pixels = torch.cat([seen.photo, counts[..., None]], dim=-1).permute(2, 0, 1)[None]
    return Photo(pixels.contiguous(), camera.viewmats[0], camera.Ks[0], camera.centers[0])


def colors_in(photos: list[tuple[Photo, Rasterization]], points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(P) number of photos that show each point, (P, 3) mean and variance of their colours there."""
    count, total, squares = torch.zeros(len(points), 1), torch.zeros(len(points), 3), torch.zeros(len(points), 3)
    for photo, drawn in photos:
        assert drawn.depth is not None
        places, depths = photo.project(points)
        there = photo.look_up(drawn.depth.permute(0, 3, 1, 2), places[:, None], "nearest")[0, :, 0]
        found = photo.look_up(photo.pixels, places[:, None])[:, :, 0].T
        shows = (there > 0) & ((there - depths).abs() < SAME * depths) & (found[:, 3] > WHOLE)
        color = torch.where(shows[:, None], found[:, :3], 0.0)
        count, total, squares = count + shows[:, None], total + color, squares + color.square()
    mean = total / count.clamp_min(1)
    return count[:, 0], mean, (squares - count * mean.square()) / (count - 1).clamp_min(1)


def decibels(squares: list[Tensor]) -> str:
    """The mean over views of mean squares, as a PSNR."""
    return f"{-10 * torch.stack(squares).mean().log10():.2f}"


@torch.no_grad()
def rows(mesh: TriangleMesh, capture: Dataset, background: tuple[float, float, float]) -> list[list[str]]:
    """The table's; it takes the mesh as it is."""
    scorer = Scorer(capture, torch.device("cpu"), background=background)
    training = [(scorer.see(mesh, view), nearest(mesh, capture, view)) for view in capture.train]
    photos = [
        (photo_of(seen, capture, view), drawn) for view, (seen, drawn) in zip(capture.train, training, strict=True)
    ]
    counts = photos_showing(mesh, [drawn for _, drawn in training])
    shares, spread, mean_off, mesh_off = Shares(), [], [], []
    tests = [scorer.see(mesh, view) for view in capture.test]
    for view, seen in zip(capture.test, tests, strict=True):
        drawn = nearest(mesh, capture, view)
        assert drawn.triangle is not None
        error = (seen.counting(seen.splatted) - seen.photo).square().flatten(0, 1)
        triangle = drawn.triangle.flatten().long()
        shares.pixels.append(counts[triangle])
        shares.errors.append(error.sum(dim=1))
        number, mean, variance = colors_in(photos, points_seen(mesh, drawn))
        twice = (number >= 2) & (triangle >= 0)
        off = seen.counting(mean.view_as(seen.photo)) - seen.photo
        for found, squares in ((spread, variance), (mean_off, off.square().flatten(0, 1)), (mesh_off, error)):
            found.append(squares[twice].mean())
    scores = [mean_psnr([seen for seen, _ in training]), mean_psnr(tests), mean_psnr(tests, fitted_colors=True)]
    return [
        ["training views / test views, dB", f"{scores[0]:.2f} / {scores[1]:.2f}"],
        ["test views, colours of each fitted to its photo", f"{scores[2]:.2f}"],
        ["no triangle", shares.text(-1, -1)],
        *([f"shown by {name}", shares.text(*limits)] for name, limits in SHOWN.items()),
        ["spread of the photos", decibels(spread)],
        ["their mean / the mesh in the same pixels", f"{decibels(mean_off)} / {decibels(mesh_off)}"],
    ]


def mean_psnr(views: list[Seen], *, fitted_colors: bool = False) -> float:
    """Of views of the mesh, as it is or in the colours of each photo."""
    found = [psnr(seen.counting(seen.fitted if fitted_colors else seen.splatted), seen.photo) for seen in views]
    return sum(found) / len(found)


def main() -> None:
    """One capture."""
    capture, config, kept = start(__doc__)
    mesh, _ = fitted(capture, config, kept)
    table = rows(mesh, capture, background_of(config))
    print(Table("Where the error of test views comes from", ["", kept.name], table).markdown())


if __name__ == "__main__":
    main()
