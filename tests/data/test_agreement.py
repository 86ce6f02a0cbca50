"""What no photo sees of a surface, and how far photos agree on what they show of it."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from etsplat.core.cameras import camera_centers
from etsplat.data.agreement import agreement, contradicted, looked_at, unseen_share, unseen_vertices
from etsplat.data.kept import keeping
from etsplat.data.photograph import photograph
from etsplat.data.photos import Photo, photos_of, pixel_size
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from helpers.painting import mean_colors, painted_pictures


def test_of_a_ball_all_is_seen_and_of_a_deep_pit_in_it_the_bottom_is_not() -> None:
    vertices, faces = icosphere(4)
    unseen = unseen_vertices(photograph(MeshFile(vertices, faces), 400, 400, supersampling=1))
    assert not unseen(vertices, faces).any()
    pit = vertices[:, 1] > 0.98
    assert pit.sum() > 10
    for depth, hides in ((0.2, False), (1.2, True)):
        cut = torch.where(pit[:, None], vertices - torch.tensor([0.0, depth, 0.0]), vertices)
        hidden = unseen(cut, faces)
        assert bool(hidden[pit].all()) is hides
        assert bool(hidden[pit].any()) is hides
        assert not hidden[~pit].any()


def test_of_a_ball_that_is_seen_from_above_alone_the_lower_part_is_in_no_photo() -> None:
    vertices, faces = icosphere(4)
    views = photograph(MeshFile(vertices, faces), 200, 200, supersampling=1, elevations=[60.0])
    assert unseen_share(looked_at(views, vertices, faces)) == pytest.approx(0.41, abs=0.02)  # below -11 degrees
    around = photograph(MeshFile(vertices, faces), 200, 200, supersampling=1)
    assert unseen_share(looked_at(around, vertices, faces)) == 0
    assert unseen_share(None) == 0


def looked_up(plane: Tensor, places: Tensor, mode: str) -> Tensor:
    """(C, P) of (C, H, W) at (P, 2) pixels."""
    size = torch.tensor(plane.shape[:0:-1])
    grid = (2 * places / size - 1)[None, None].float()
    return grid_sample(plane[None].float(), grid, mode=mode, align_corners=False)[0, :, 0].double()


def agreed(
    photos: list[Photo], masks: list[Tensor], point: Tensor, normal: Tensor, seen: Tensor, pixel: float
) -> float:
    """Of one point: correlations of 7 x 7 pixels, in double precision."""
    across = torch.tensor([1.0, 0, 0] if abs(normal[0]) < 0.7 else [0.0, 1, 0]).double()
    u = torch.linalg.cross(normal, across)
    u = u / u.norm()
    v = torch.linalg.cross(normal, u)
    shown = []
    for photo, mask, sees in zip(photos, masks, seen, strict=True):
        way = photo.center.double() - point
        cosine = float(way @ normal / way.norm())
        if not sees or cosine <= 0.2:
            continue
        steps = pixel * torch.arange(-3, 4).double()
        grid = point + (steps[:, None, None] * v + steps[:, None] * u).reshape(-1, 3)
        camera = grid @ photo.viewmat[:3, :3].double().T + photo.viewmat[:3, 3]
        places = (camera @ photo.K.double().T)[:, :2] / camera[:, 2:]
        counts = looked_up(mask[0], places, "nearest")[0]
        colors = looked_up(photo.pixels[0, :3], places, "bilinear")
        colors = counts * (colors - (counts * colors).sum(dim=1, keepdim=True) / counts.sum().clamp_min(1))
        if counts.mean() > 0.7 and colors.norm() > 0.01 * (3 * 49) ** 0.5:
            shown.append((cosine, colors / colors.norm()))
    squarest = [colors for _, colors in sorted(shown, key=lambda each: -each[0])]
    if len(squarest) < 3:
        return torch.nan
    pairs = [float((a * b).sum()) for i, a in enumerate(squarest) for b in squarest[:i]]
    best = sorted(pairs, reverse=True)[: (len(pairs) + 1) // 2]
    return sum(best) / len(best)


@pytest.fixture
def threads():
    before = num_threads()
    yield
    set_num_threads(before)


def noisy_photos(azimuths: int, generator: torch.Generator) -> list[Photo]:
    """Of a ball, with other noise over the same in each."""
    photos = photos_of(photograph(MeshFile(*icosphere(3)), 96, 80, elevations=(20.0,), azimuths=azimuths))
    common = torch.rand(photos[0].pixels.shape, generator=generator)
    noise = [torch.rand(photo.pixels.shape, generator=generator) for photo in photos]
    return [replace(photo, pixels=(common + own) / 2) for photo, own in zip(photos, noise, strict=True)]


@pytest.mark.usefixtures("threads")
def test_agreement_is_the_mean_of_the_better_half_of_correlations() -> None:
    generator = torch.Generator().manual_seed(0)
    photos = noisy_photos(12, generator)  # no more than are asked at a point
    photos[3] = replace(photos[3], pixels=photos[3].pixels[..., :70, :50].contiguous())
    photos[5].pixels.fill_(0.5)
    masks = [(torch.rand(photo.pixels[:, 3:].shape, generator=generator) < 0.8).float() for photo in photos]
    points = icosphere(3)[0] * (0.9 + 0.2 * torch.rand(642, 1, generator=generator))
    normals = normalize(points + 0.3 * torch.randn(points.shape, generator=generator), dim=1)
    seen = torch.rand(len(photos), len(points), generator=generator) < 0.8
    pixel = pixel_size(photos)
    found = agreement(photos, masks, points, normals, seen, pixel, fewest=3)
    each = zip(points.double(), normals.double(), seen.T, strict=True)
    expected = torch.tensor([agreed(photos, masks, *one, pixel) for one in each])
    assert 0.2 < found.isnan().float().mean() < 0.8
    # A pixel that is nearest within rounding may be another.
    assert torch.isclose(found, expected, atol=1e-3, equal_nan=True).float().mean() > 0.99
    set_num_threads(3)
    again = agreement(photos, masks, points, normals, seen, pixel, fewest=3)
    assert torch.equal(found.view(torch.int32), again.view(torch.int32))


def test_no_more_photos_than_twelve_are_asked() -> None:
    photos = noisy_photos(40, torch.Generator().manual_seed(0))
    masks = [torch.ones_like(photo.pixels[:, 3:]) for photo in photos]
    points, _ = icosphere(3)
    centers = torch.stack([photo.center for photo in photos])
    cosine = (normalize(centers[:, None] - points, dim=2) * points).sum(dim=2)
    twelve = cosine >= cosine.topk(12, dim=0).values[-1]
    every, best = (
        agreement(photos, masks, points, points, seen, pixel_size(photos), fewest=3)
        for seen in (torch.ones_like(twelve), twelve)
    )
    assert torch.isclose(every, best, equal_nan=True).float().mean() > 0.9  # but for equal cosines
    assert (~every.isnan()).sum() > 100


@pytest.mark.parametrize(("photos", "fewest"), [(9, 3), (20, 4), (32, 5)])
def test_what_hardly_a_photo_sees_contradicts_nothing(photos: int, fewest: int) -> None:
    """The more photos there are, the more see a lid over a hollow; where few see what is in it, it is noise."""
    vertices, faces, views = painted_pictures(*icosphere(3), painted=False)
    highest = sorted(views.train, key=lambda index: -float(camera_centers(views.viewmats[index][None])[0, 1]))
    looked = looked_at(replace(views, train=highest[:photos]), vertices, faces)
    assert looked is not None
    colors = mean_colors(views, vertices, faces)
    colors[vertices[faces].mean(dim=1)[:, 1] > 0.8] += 0.1
    for seeing, counted in ((fewest - 1, False), (fewest, True)):
        sees = looked.seen & (torch.arange(photos)[:, None] < seeing)
        few = looked._replace(seen=sees, score=torch.zeros(len(vertices)))
        assert (contradicted(few, colors) > 0.05) is counted


@pytest.mark.parametrize(("shift", "counted"), [(0.01, False), (0.018, True)])
def test_what_colours_explain_is_not_contradicted(shift: float, counted: bool) -> None:
    """Nowhere on a plain ball do photos correlate; colours are a little wrong, on its cap by so much more."""
    vertices, faces, views = painted_pictures(*icosphere(3), painted=False)
    looked = looked_at(views, vertices, faces)
    assert looked is not None
    colors = mean_colors(views, vertices, faces) + 0.002
    cap = vertices[faces].mean(dim=1)[:, 1] > 0.5
    colors[cap] += shift
    found = contradicted(looked._replace(score=torch.zeros(len(vertices))), colors)
    assert (found > 0.1) is counted
    assert found < 0.4


def test_the_latest_surfaces_are_looked_at_once_while_a_start_is_made() -> None:
    views, faces = photograph(MeshFile(*icosphere(2)), 32, 32), icosphere(2)[1]
    surfaces = [icosphere(2)[0] * size for size in (1.0, 0.9, 0.8, 0.7)]
    with keeping():
        first = looked_at(views, surfaces[0], faces)
        assert looked_at(views, surfaces[0], faces) is first
        for surface in surfaces[1:]:
            looked_at(views, surface, faces)
        assert looked_at(views, surfaces[0], faces) is not first
    assert looked_at(views, surfaces[0], faces) is not looked_at(views, surfaces[0], faces)
