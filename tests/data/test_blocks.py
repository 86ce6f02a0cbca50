"""A scene is cut into blocks of equal content, and photos go to the blocks that they show."""

import math
from dataclasses import replace

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.blocks import COVERED, MARGIN, chosen_shape, covered, cut, parse_blocks, parts_of, views_of
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import LazyPictures, Picture, StoredPictures
from helpers.captures import small_demo_scene

UP = torch.tensor([0.0, 1.0, 0.0])


def field(points: torch.Tensor, eyes: list[tuple[float, float]] | None = None) -> Dataset:
    """Cameras two units above the ground that look straight down, 90 degrees wide, over points."""
    eyes = eyes or [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)]
    down = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(len(eyes), 1, 1)
    for viewmat, (x, z) in zip(viewmats, eyes, strict=True):
        viewmat[:3, :3] = down
        viewmat[:3, 3] = -down @ torch.tensor([x, 2.0, z], dtype=torch.float64)
    K = torch.tensor([[16.0, 0, 16], [0, 16.0, 16], [0, 0, 1]], dtype=torch.float64)
    return Dataset(
        viewmats,
        K.expand(len(eyes), 3, 3),
        StoredPictures([torch.full((32, 32, 3), index, dtype=torch.uint8) for index in range(len(eyes))]),
        [f"photo_{index}" for index in range(len(eyes))],
        list(range(len(eyes))),
        [],
        exact_points=points.double(),
        point_colors=torch.rand(len(points), 3),
    )


def ground(count: int, width: float, depth: float, generator: torch.Generator) -> torch.Tensor:
    """Points on the ground, more and more crowded towards the origin."""
    places = torch.rand(count, 2, generator=generator) ** 2
    return torch.stack([places[:, 0] * width, 0.01 * torch.rand(count, generator=generator), places[:, 1] * depth], 1)


@pytest.mark.parametrize("shape", [(2, 1), (3, 2), (1, 4)])
def test_blocks_hold_equally_many_points(rng: torch.Generator, shape: tuple[int, int]) -> None:
    """However unevenly they lie; columns follow the longer side of the ground, and up does not matter."""
    points = ground(1200, 9.0, 3.0, rng)
    grid = cut(field(points), shape, UP)
    counts = torch.bincount(grid.block_of(points), minlength=len(grid))
    assert len(counts) == shape[0] * shape[1]
    assert int(counts.max() - counts.min()) <= shape[1]
    assert abs(float(grid.across[0] @ torch.tensor([1.0, 0, 0], dtype=torch.float64))) > 0.9
    lifted = points + torch.tensor([0.0, 5.0, 0.0])
    assert torch.equal(grid.block_of(points), grid.block_of(lifted))


def test_every_place_is_in_one_block_and_around_its_neighbours(rng: torch.Generator) -> None:
    """Margins are a tenth of a block's width; blocks at the rim have none to the outside, and no end."""
    points = ground(1000, 8.0, 4.0, rng)
    grid = cut(field(points), (2, 2), UP)
    far = 100 * (torch.rand(500, 3, generator=rng) - 0.5)
    block = grid.block_of(far)
    assert int(block.min()) >= 0
    assert int(block.max()) < 4
    around = torch.stack([grid.around(each, points) for each in range(4)])
    own = around.gather(0, grid.block_of(points)[None])[0]
    assert bool(own.all())
    assert 1.0 < float(around.sum()) / len(points) < 1.7
    assert bool(torch.stack([grid.around(each, far) for each in range(4)]).any(dim=0).all())
    distance = grid.distance(points)
    alone = around.sum(dim=0) == 1
    assert float(distance[~alone].min()) < MARGIN / 2
    assert float(distance[alone].max()) > MARGIN
    assert float(distance.min()) >= 0


def test_photos_go_to_the_blocks_that_cover_them(rng: torch.Generator) -> None:
    """Two fields of points far apart, a camera over each and one between them that sees a strip of both."""
    left = ground(300, 2.0, 2.0, rng) - torch.tensor([1.0, 0, 1.0])
    capture = field(torch.cat([left, left + torch.tensor([4.0, 0, 0])]), [(0.0, 0.0), (4.0, 0.0), (2.0, 0.0)])
    grid = cut(capture, (2, 1), UP)
    shares = covered(capture, grid)
    first = int(grid.block_of(torch.tensor([[0.0, 0, 0]])))
    assert shares[0].tolist() == pytest.approx([1.0 - first, float(first)])
    assert shares[1].tolist() == pytest.approx([float(first), 1.0 - first])
    assert float(shares[2].min()) > COVERED
    assert sorted(map(tuple, views_of(shares))) == [(0, 2), (1, 2)]


def test_what_is_hidden_does_not_count() -> None:
    """Of each bin of a photo the nearest point counts: a roof in one block hides the ground of the other behind it."""
    line = torch.linspace(-0.9, 0.9, 40)
    x, z = (axis.flatten() for axis in torch.meshgrid(line, line, indexing="ij"))
    floor = torch.stack([x, torch.zeros_like(x), 0.7 * z], 1)
    capture = field(floor, [(-0.9, 0.0), (-0.9, 0.1)])
    grid = cut(capture, (2, 1), UP)
    roof = torch.stack([0.2 * x - 0.22, torch.full_like(x, 1.0), 0.6 * z], 1)
    under = replace(capture, exact_points=torch.cat([floor, roof]).double(), point_colors=None)
    hidden = int(grid.block_of(torch.tensor([[0.5, 0.0, 0.0]])))
    assert float(covered(capture, grid)[0, hidden]) > 0.4
    assert float(covered(under, grid)[0, hidden]) < 0.25


def test_photos_that_show_little_of_all_blocks_belong_to_the_first_of_them() -> None:
    shares = torch.tensor([[0.05, 0.06, 0.04], [0.0, 0.0, 0.0], [0.5, 0.3, 0.2]])
    assert views_of(shares) == [[2], [0, 2], [2]]


def test_parts_are_captures_with_photos_of_their_own(rng: torch.Generator) -> None:
    capture = small_demo_scene().watching(8)
    grid = cut(capture, (2, 1), UP)
    parts = parts_of(capture, grid)
    points = capture.exact_points
    assert points is not None
    for part in parts:
        assert part.exact_points is not None
        assert len(points) / 2 <= len(part.exact_points) < len(points)
        for number, name in enumerate(part.names):
            old = capture.names.index(name)
            assert torch.equal(part.images[number], capture.images[old])
            assert torch.equal(part.viewmats[number], capture.viewmats[old])
            for split in ("train", "test", "watched"):
                assert (number in getattr(part, split)) == (old in getattr(capture, split))
    assert len({part.fingerprint() for part in parts}) == 2


def test_lazy_photos_of_a_part_are_made_and_kept_for_it_alone() -> None:
    made = []

    def make(index: int) -> Picture:
        made.append(index)
        return Picture(torch.full((2, 2, 3), index, dtype=torch.uint8))

    whole = LazyPictures(make, [(2, 2)] * 5, [12] * 5, lambda: b"whole", limit=0)
    some = whole.subset([3, 1])
    assert whole.streamed
    assert not some.streamed
    assert int(some[0][0, 0, 0]) == 3
    assert int(some[1][0, 0, 0]) == 1
    assert sorted(made) == [1, 3]
    assert whole.held_bytes == 0
    assert some.held_bytes == some.total_bytes == 24
    assert len({whole.fingerprint(), some.fingerprint(), whole.subset([1, 3]).fingerprint()}) == 3


def test_auto_counts_photos_and_points_and_makes_square_blocks(rng: torch.Generator) -> None:
    points = ground(1000, 8.0, 2.0, rng)
    capture = field(points)
    assert chosen_shape(capture, UP, 10_000) == (1, 1)
    columns, rows = chosen_shape(capture, UP, 500)
    assert columns * rows >= 4
    assert columns > rows


@pytest.mark.parametrize("text", ["3", "0x2", "1x1", "3x", "3X2x1", "2x-1", "99x99", "", "automatic"])
def test_other_words_are_no_blocks(text: str) -> None:
    with pytest.raises(InputError, match=r"blocks: is .*columns and rows, as 3x2"):
        parse_blocks(text)


def test_blocks_are_columns_by_rows() -> None:
    assert parse_blocks("3x2") == (3, 2)
    assert parse_blocks("auto") is None


def test_scenes_that_cannot_be_cut_are_refused(rng: torch.Generator) -> None:
    """No points, too few of them, too few photos of a block."""
    points = ground(400, 8.0, 2.0, rng)
    with pytest.raises(InputError, match=r"the capture has none; train it without blocks$"):
        cut(replace(field(points), exact_points=None, point_colors=None), (2, 1), UP)
    with pytest.raises(InputError, match="9x9 are too many for 400 points"):
        cut(field(points), (9, 9), UP)
    alone = field(ground(400, 40.0, 2.0, rng), [(0.5, 0.5), (0.6, 0.5)])
    with pytest.raises(InputError, match=r"2x1: 0 training photos show block \d_0; choose fewer blocks"):
        parts_of(alone, cut(alone, (2, 1), UP))


def test_without_an_up_the_ground_is_where_points_are_spread(rng: torch.Generator) -> None:
    points = ground(1000, 8.0, 3.0, rng)
    grid = cut(field(points), (2, 2), None)
    assert float(grid.across[:, 1].abs().max()) < 0.05
    assert math.isclose(float(grid.across[0] @ grid.across[1]), 0, abs_tol=1e-9)
