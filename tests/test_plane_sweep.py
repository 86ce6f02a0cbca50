"""Depths that a plane sweep finds of a wall whose place is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.plane_sweep import Sweep, correlation
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset, Normalization
from etsplat.data.pictures import StoredPictures
from etsplat.io.ply_tables import encode_ply
from etsplat.io.point_clouds import load_cloud

WIDTH, HEIGHT, TILT = 72, 54, 0.3


def painted(x: torch.Tensor, y: torch.Tensor, seed: int) -> torch.Tensor:
    """Waves in all directions, a colour at every place."""
    random = torch.Generator().manual_seed(seed)
    waves = 9 * torch.randn(24, 2, generator=random).double()
    phases = 6.3 * torch.rand(24, 3, generator=random).double()
    angles = (x[..., None] * waves[:, 0] + y[..., None] * waves[:, 1])[..., None] + phases
    return (0.5 + 0.1 * angles.sin().sum(dim=-2)).clamp(0, 1)


def wall(shown: tuple[int, ...] = (0, 0, 0, 0, 0)) -> Dataset:
    """Photos of z = 4 + TILT x from places side by side, each of what is painted there by a seed."""
    K = torch.tensor([[70.0, 0, WIDTH / 2], [0, 70, HEIGHT / 2], [0, 0, 1]]).double()
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    sights = torch.stack([(x - WIDTH / 2) / 70, (y - HEIGHT / 2) / 70, torch.ones_like(x)], dim=2).double()
    viewmats, photos = torch.eye(4).double().repeat(len(shown), 1, 1), []
    for view, seed in enumerate(shown):
        place = torch.tensor([0.4 * view - 0.8, 0.1 * (view % 2), 0.05 * view]).double()
        viewmats[view, :3, 3] = -place
        depth = (4 + TILT * place[0] - place[2]) / (sights[..., 2] - TILT * sights[..., 0])
        points = place + sights * depth[..., None]
        photos.append((255 * painted(points[..., 0], points[..., 1], seed)).round().byte())
    across, up = torch.meshgrid(torch.linspace(-1.5, 1.5, 9), torch.linspace(-1, 1, 7), indexing="xy")
    points = torch.stack([across, up, 4 + TILT * across], dim=2).reshape(-1, 3).double()
    names = [f"{view}.png" for view in range(len(shown))]
    return Dataset(
        viewmats, K.repeat(len(shown), 1, 1), StoredPictures(photos), names, list(range(len(shown))), [], points
    )


def test_a_wall_is_found_where_it_is(tmp_path: Path) -> None:
    """Nearly all that several photos show, within 1 % of its depth, facing them, in the input's units."""
    dataset = replace(wall(), normalization=Normalization(torch.tensor([10.0, 0, 0]).double(), 2.0))
    table = Sweep(dataset).cloud()
    path = tmp_path / "cloud.ply"
    path.write_bytes(encode_ply({"vertex": table}))
    points, colors = load_cloud(path)
    points = (points - torch.tensor([10.0, 0, 0])) / 2
    off = (points[:, 2] - TILT * points[:, 0] - 4).abs()
    assert len(points) > 0.6 * 5 * WIDTH * HEIGHT
    assert float(off.quantile(0.5)) < 0.01
    assert float((off < 0.04).float().mean()) > 0.98
    front = torch.tensor([TILT, 0, -1]) / (1 + TILT**2) ** 0.5
    facing = sum(float(front[axis]) * table[name] for axis, name in enumerate(("nx", "ny", "nz")))
    assert np.mean(facing > 0.9) > 0.9
    assert colors is not None
    near = painted(points[:, 0].double(), points[:, 1].double(), 0)
    assert float((colors - near).abs().median()) < 0.05


def test_photos_of_something_else_have_no_points() -> None:
    """The third and the fifth show another painting each: nothing of them agrees with the others."""
    sweep = Sweep(wall((0, 0, 1, 0, 2)))
    kept = [float(sweep.agreed(view)[1].float().mean()) for view in range(5)]
    assert max(kept[2], kept[4]) < 0.02
    assert min(kept[0], kept[1], kept[3]) > 0.4


def test_correlation_is_one_of_what_is_lit_otherwise() -> None:
    """Not of grey without anything in it."""
    picture = torch.rand(20, 20, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(correlation(picture, 0.4 * picture + 0.3), torch.ones(20, 20), atol=1e-3, rtol=0)
    torch.testing.assert_close(correlation(picture, 1 - picture), -torch.ones(20, 20), atol=1e-3, rtol=0)
    assert float(correlation(picture, torch.full((20, 20), 0.5)).max()) == -1


def test_a_capture_without_points_is_refused() -> None:
    """Nothing says where to look."""
    with pytest.raises(InputError, match="points: the capture has none"):
        Sweep(replace(wall(), exact_points=None))
