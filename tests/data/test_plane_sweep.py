"""Depths that photos agree on, of a wall whose depths are known."""

import math
from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.data.plane_sweep import swept_points
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.optim.loop import Event, NoteEvent
from etsplat.tasks.dense_starts import LEAST_SHARE, POOR, with_swept_points

CPU = torch.device("cpu")
W, H = 96, 64
NORMAL, OFFSET = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64), 4.0
"""The wall: where NORMAL x = OFFSET."""


def painted(points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Waves of many lengths, a colour for each place of the wall."""
    generator = torch.Generator().manual_seed(3)
    waves = 8 * torch.randn((24, 2), generator=generator, dtype=torch.float64)
    phases = 2 * math.pi * torch.rand((24, 3), generator=generator, dtype=torch.float64)
    angles = (points[..., :2] @ waves.T)[..., None] + phases
    return (0.5 + 0.5 * angles.sin().mean(dim=-2) * 2).clamp(0.0, 1.0)


def wall(count: int = 5, *, alike: bool = True) -> Dataset:
    """Photos of the wall from places side by side, with some points on it; or of nothing that is in two of them."""
    K = torch.tensor([[100.0, 0.0, W / 2], [0.0, 100.0, H / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rows, columns = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1).double() @ torch.linalg.inv(K).T
    poses, photos, generator = [], [], torch.Generator().manual_seed(0)
    for number in range(count):
        center = torch.tensor([0.4 * (number - count // 2), 0.1 * (number % 2), 0.0], dtype=torch.float64)
        depths = (OFFSET - NORMAL @ center) / (rays @ NORMAL)
        colors = painted(center + rays * depths[..., None])
        photo = colors if alike else torch.rand((H, W, 3), generator=generator)
        photos.append((255 * photo).round().to(torch.uint8))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -center
        poses.append(pose)
    across = 1.5 * (2 * torch.rand((300, 2), generator=generator, dtype=torch.float64) - 1)
    points = torch.cat([across, ((OFFSET - across @ NORMAL[:2]) / NORMAL[2])[:, None]], dim=1)
    return Dataset(
        viewmats=torch.stack(poses),
        Ks=K.repeat(count, 1, 1),
        images=StoredPictures(photos),
        names=[f"{number}" for number in range(count)],
        train=list(range(count)),
        test=[],
        exact_points=points,
        point_colors=painted(points).float(),
    )


def nothing(_: int, __: int) -> None:
    pass


def test_points_lie_on_the_wall() -> None:
    """Where three photos see it: a hundredth of the depth off at most, much less in the median, in its colours."""
    swept = swept_points(wall(7), CPU)
    off = (swept.positions @ NORMAL - OFFSET).abs() / NORMAL.norm()
    assert swept.share > 0.3
    assert float(off.median()) < 0.003 * OFFSET
    assert float(off.quantile(0.99)) < 0.015 * OFFSET
    assert float((swept.colors - painted(swept.positions)).abs().mean()) < 0.02


def test_other_photos_find_less_of_what_one_finds_by_poorer_poses() -> None:
    """Each camera turned about another axis, by a quarter of a degree and by a whole one."""
    capture, found = wall(7), list[float]()
    axes = normalize(torch.randn((len(capture), 3), generator=torch.Generator().manual_seed(2)), dim=1).double()
    crossed = torch.stack([torch.linalg.cross(axes, each.expand_as(axes)) for each in torch.eye(3).double()], dim=2)
    for degrees in (0.0, 0.25, 1.0):
        turned = capture.viewmats.clone()
        turned[:, :3] = torch.linalg.matrix_exp(math.radians(degrees) * crossed) @ turned[:, :3]
        found.append(swept_points(replace(capture, viewmats=turned), CPU).consistent)
    assert found[0] > 0.7 > POOR > found[1] > 1.5 * found[2], found


def test_bits_do_not_depend_on_threads() -> None:
    """Nor on those of torch."""
    before, ours, found = torch.get_num_threads(), num_threads(), []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        set_num_threads(threads)
        found.append(swept_points(wall(), CPU))
    torch.set_num_threads(before)
    set_num_threads(ours)
    assert torch.equal(found[0].positions, found[1].positions)
    assert torch.equal(found[0].colors, found[1].colors)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_finds_the_same_places() -> None:
    """But for a few that just count or just do not; with the same bits each time, as tensors of the CPU."""
    found, again, here = (swept_points(wall(), torch.device(device)) for device in ("cuda", "cuda", "cpu"))
    assert found.positions.is_cpu
    assert torch.equal(found.positions, again.positions)
    assert abs(found.share - here.share) < 0.01 * here.share
    nearest = torch.cdist(found.positions, here.positions).amin(dim=1)
    assert float(nearest.quantile(0.95)) < 1e-4 * OFFSET


def test_photos_of_different_things_agree_on_nothing() -> None:
    """Not even by chance; then the capture keeps its own points, and the run says why."""
    capture = wall(alike=False)
    swept = swept_points(capture, CPU)
    assert swept.share < LEAST_SHARE / 10
    assert math.isnan(swept.consistent), "each finds nothing by itself, as of a blank wall"
    events = list[Event]()
    assert with_swept_points(capture, 4000, CPU, events.append, nothing)[0] is capture
    assert any(isinstance(each, NoteEvent) and "agree on 0 %" in each.text for each in events)


def test_what_masks_exclude_or_is_transparent_gets_no_points() -> None:
    """The left half by alpha, the upper one by a mask."""
    capture = wall()
    masks = [torch.full((H, W), 255, dtype=torch.uint8) for _ in capture.train]
    photos = []
    for photo, mask in zip(capture.images, masks, strict=True):
        alpha = torch.full((H, W, 1), 255, dtype=torch.uint8)
        alpha[:, : W // 2] = 0
        mask[: H // 2] = 0
        photos.append(torch.cat([torch.where(alpha > 0, photo, 0), alpha], dim=-1).to(torch.uint8))
    masked = replace(capture, images=StoredPictures(photos, masks))
    swept, whole = swept_points(masked, CPU), swept_points(capture, CPU)
    assert 0 < len(swept.positions) < len(whole.positions) / 3
    middle = capture.viewmats[2, :3, 3]  # of the leftmost camera's frame the right half alone is left
    assert float((swept.positions + middle)[:, 1].quantile(0.05)) > -0.3


def test_what_is_found_joins_the_points_of_the_capture() -> None:
    """Up to half of the triangles that there may be, or to as many as the capture has, two thirds of which stay."""
    events, capture = list[Event](), wall()
    dense, _ = with_swept_points(capture, 4000, CPU, events.append, nothing)
    assert capture.exact_points is not None
    assert dense.exact_points is not None
    assert dense.point_colors is not None
    assert torch.equal(dense.exact_points[:300], capture.exact_points)
    assert 1000 < len(dense.exact_points) == len(dense.point_colors) <= 2000
    assert any(isinstance(each, NoteEvent) and "join 300 of the capture's 300 points" in each.text for each in events)
    full, _ = with_swept_points(capture, 600, CPU, events.append, nothing)
    assert full.exact_points is not None
    assert 200 < len(full.exact_points) <= 300
    assert any(isinstance(each, NoteEvent) and "of the capture's 300 points" in each.text for each in events[-1:])


def test_what_is_found_has_its_colours_beside_points_without() -> None:
    """Those are grey, as they are where nothing is found."""
    dense, _ = with_swept_points(replace(wall(), point_colors=None), 4000, CPU, list[Event]().append, nothing)
    assert dense.exact_points is not None
    assert dense.point_colors is not None
    assert (dense.point_colors[:300] == 0.5).all()
    assert float((dense.point_colors[300:] - painted(dense.exact_points[300:])).abs().mean()) < 0.05


def test_a_photo_from_beyond_the_nearest_plane_is_no_obstacle() -> None:
    """What is nearest lies behind its camera, where it has no place in its photo."""
    capture = wall(6)
    ahead = capture.viewmats.clone()
    ahead[5, :3, 3] = torch.tensor([0.0, 0.0, -3.7], dtype=torch.float64)
    assert swept_points(replace(capture, viewmats=ahead), CPU).share > 0.15


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_without_points_photos_say_how_far_away_things_are(scale: float) -> None:
    """In units of any size: places on the wall, in its colours, half as many as there may be triangles."""
    events, capture = list[Event](), wall(7)
    viewmats = capture.viewmats.clone()
    viewmats[:, :3, 3] *= scale
    blind = replace(capture, viewmats=viewmats, exact_points=None, point_colors=None)
    dense, consistent = with_swept_points(blind, 4000, CPU, events.append, nothing)
    assert dense.exact_points is not None
    assert dense.point_colors is not None
    assert consistent > POOR
    assert 500 < len(dense.exact_points) == len(dense.point_colors) <= 2000
    places = dense.exact_points / scale
    assert float(((places @ NORMAL - OFFSET).abs() / NORMAL.norm()).quantile(0.95)) < 0.015 * OFFSET
    assert float((dense.point_colors - painted(places)).abs().mean()) < 0.05
    assert any(isinstance(each, NoteEvent) and "these places are the start" in each.text for each in events)


def test_without_points_photos_of_different_things_start_nothing() -> None:
    """The run begins at random places, and says why."""
    events, capture = list[Event](), replace(wall(alike=False), exact_points=None, point_colors=None)
    assert with_swept_points(capture, 4000, CPU, events.append, nothing)[0] is capture
    assert any(isinstance(each, NoteEvent) and "random places" in each.text for each in events)
