"""Vertices go to where masks have their outlines, closer than pixels are wide, and nowhere else."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.outlines import outlines
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.distance import closest_points
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile

PIXEL = 0.021  # of 96 across, in units of the radius


@pytest.fixture(scope="module")
def egg() -> tuple[torch.Tensor, torch.Tensor, Dataset]:
    """A smooth solid in the unit frame, and 40 views of it."""
    vertices, faces = icosphere(4)
    vertices = vertices * torch.tensor([1.0, 0.7, 0.8])
    views = photograph(MeshFile(vertices, faces), 96, 96)
    return views.normalization.apply(vertices), faces, views


def off(egg) -> tuple[torch.Tensor, MeshTopology]:
    """Its surface half a pixel inside of where it is, with half as much noise."""
    unit, faces, _ = egg
    noise = torch.randn(len(unit), 1, generator=torch.Generator().manual_seed(0)).clamp(-2, 2)
    return unit * (1 + 0.5 * PIXEL * (0.5 * noise - 1)), MeshTopology.from_faces(faces, len(unit))


def distances(vertices: torch.Tensor, egg) -> torch.Tensor:
    return closest_points(vertices.double(), egg[0].double(), egg[1])[0].sqrt()


def with_alpha(views: Dataset, change: Callable[[int, torch.Tensor], torch.Tensor]) -> Dataset:
    """The same views with other masks."""
    images = []
    for index, image in enumerate(views.images):
        pixels = image.float() / 255 if image.dtype == torch.uint8 else image.clone()
        pixels[..., 3] = change(index, pixels[..., 3])
        images.append(pixels)
    return replace(views, images=StoredPictures(images))


def test_vertices_end_within_a_small_part_of_a_pixel(egg) -> None:
    vertices, topology = off(egg)
    fitted = outlines(egg[2])(vertices, topology)
    before, after = distances(vertices, egg), distances(fitted, egg)
    assert float(before.median()) > 0.4 * PIXEL
    assert float(after.median()) < 0.12 * PIXEL
    assert float(after.square().mean().sqrt()) < 0.22 * PIXEL  # dents are at no outline


def test_masks_of_whole_pixels_will_do(egg) -> None:
    vertices, topology = off(egg)
    views = with_alpha(egg[2], lambda _, alpha: (alpha >= 0.5).float())
    assert float(distances(outlines(views)(vertices, topology), egg).median()) < 0.2 * PIXEL


def test_masks_that_are_rough_say_nothing(egg) -> None:
    """Each by a pixel and a half, in any direction."""
    vertices, topology = off(egg)
    rng = torch.Generator().manual_seed(1)
    waves = torch.nn.functional.interpolate(torch.randn(40, 2, 12, 12, generator=rng), (96, 96), mode="bicubic")
    grid = torch.stack(torch.meshgrid(torch.arange(96.0), torch.arange(96.0), indexing="xy"), dim=-1) + 0.5

    def moved(index: int, alpha: torch.Tensor) -> torch.Tensor:
        places = (grid + 1.5 * waves[index].permute(1, 2, 0)) / 48 - 1
        return torch.nn.functional.grid_sample(alpha[None, None], places[None], align_corners=False)[0, 0]

    assert torch.equal(outlines(with_alpha(egg[2], moved))(vertices, topology), vertices)


def test_a_photo_whose_mask_is_wrong_is_outvoted(egg) -> None:
    """One of forty, by two pixels."""
    vertices, topology = off(egg)
    right = outlines(egg[2])(vertices, topology)
    wrong = with_alpha(egg[2], lambda index, alpha: alpha.roll(2, dims=1) if index == egg[2].train[3] else alpha)
    assert float((outlines(wrong)(vertices, topology) - right).norm(dim=1).max()) < 0.5 * PIXEL


@pytest.mark.parametrize("shown", ["all", "nothing", "without alpha"])
def test_all_stay_where_there_is_no_outline(egg, shown) -> None:
    vertices, topology = off(egg)
    views = with_alpha(egg[2], lambda _, alpha: torch.full_like(alpha, float(shown == "all")))
    if shown == "without alpha":
        views = replace(egg[2], images=StoredPictures([image[..., :3] for image in egg[2].images]))
    assert torch.equal(outlines(views)(vertices, topology), vertices)


def test_pixels_that_do_not_count_say_nothing(egg) -> None:
    """All masks are wrong on one side, where they are ignored."""
    views = egg[2]
    left = torch.arange(96)[None].expand(96, 96) < 48
    shifted = with_alpha(views, lambda _, alpha: torch.where(left, alpha.roll(1, dims=1), alpha))
    counted = [(~left).to(torch.uint8) * 255] * len(views)
    ignored = replace(shifted, images=StoredPictures(list(shifted.images), masks=counted))
    vertices, topology = off(egg)
    errors = [distances(outlines(each)(vertices, topology), egg).median() for each in (shifted, ignored)]
    assert float(errors[1]) < 0.15 * PIXEL < 0.25 * PIXEL < float(errors[0])


def test_what_no_outline_shows_stays_where_it_is(egg) -> None:
    """A hollow's bottom, a quarter of the radius deep."""
    unit, faces, _ = egg
    depth = (-16 * (unit - unit[unit[:, 1].argmax()]).square().sum(dim=1)).exp()
    hollow = unit - torch.tensor([0.0, 0.25, 0.0]) * depth[:, None]
    fitted = outlines(egg[2])(hollow, MeshTopology.from_faces(faces, len(hollow)))
    moved = (fitted - hollow).norm(dim=1)
    assert float(moved[depth > 0.9].max()) < 0.1 * PIXEL
