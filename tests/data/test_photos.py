"""Photos that look at an object: pixels of all at once, against one after another."""

from dataclasses import replace

import torch

from etsplat.data.photograph import photograph
from etsplat.data.photos import Photo, PixelsOf, photos_of
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile


def test_points_are_where_each_photo_shows_them() -> None:
    """Photos are of several sizes; some points are beside them, some behind cameras."""
    photos = photos_of(photograph(MeshFile(*icosphere(2)), 48, 32))
    photos = [replace(photo, pixels=photo.pixels[..., : 32 - k % 3, : 48 - k % 5]) for k, photo in enumerate(photos)]
    generator = torch.Generator().manual_seed(2)
    points = 4 * torch.rand(500, 3, generator=generator) - 2
    maps = [torch.rand(photo.pixels.shape[2:], generator=generator) for photo in photos]
    pixels = PixelsOf(photos)
    shown, depths = pixels.show(points)
    found = pixels.together(maps)[shown]
    for photo, each, at, depth in zip(photos, maps, found, depths, strict=True):
        place, z = photo.project(points)
        torch.testing.assert_close(depth, z)
        torch.testing.assert_close(at, looked_up(photo, each, place))
    assert 0.02 < float((found == 0).float().mean()) < 0.98


def looked_up(photo: Photo, values: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """What a map has at places."""
    return photo.look_up(values[None, None], place[None], "nearest")[0, 0]
