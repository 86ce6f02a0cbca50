"""What is left out of a soup, and for which reason: an exact scene, with one triangle for each."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from etsplat.core.cameras import intrinsics, look_at
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.regions import Box, Sphere
from etsplat.model.surroundings import SPHERE_TRIANGLES, Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks import soup_selection
from etsplat.tasks.opened_runs import SoupRun, training_cameras
from etsplat.tasks.soup_selection import in_words, select, surroundings_of, times_shown

BALL = 80
HIDDEN, ABOVE, LONE, SKY = BALL, BALL + 1, BALL + 2, slice(BALL + 3, None)


def shard(x: float, y: float, z: float, size: float) -> torch.Tensor:
    return torch.tensor([[x, y, z]]) + size * torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])


def capture_of(eyes: torch.Tensor) -> Dataset:
    """Photos of 320 x 240 that look at the origin; and one to test on."""
    count = len(eyes)
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    images = StoredPictures([torch.zeros(240, 320, 3, dtype=torch.uint8)] * count)
    points = 0.5 * icosphere(1)[0].double()
    return Dataset(
        viewmats.double(),
        intrinsics(60.0, 320, 240).repeat(count, 1, 1).double(),
        images,
        [f"{index:02d}" for index in range(count)],
        list(range(count - 1)),
        [count - 1],
        exact_points=points,
        point_colors=torch.full(points.shape, 0.5),
    )


@pytest.fixture
def run() -> SoupRun:
    """A ball of radius 1/2 with a triangle in it, one above all photos, one in the air, and a sky.

    That in the air is right before the first camera, and for all others too small to be seen.
    """
    angles = torch.arange(1, 7) * (2 * torch.pi / 7)
    round_about = torch.stack([2.5 * angles.sin(), (-1.0) ** torch.arange(6), 2.5 * angles.cos()], dim=1)
    capture = capture_of(torch.cat([torch.tensor([[0.0, 0, 1.5]]), round_about, torch.tensor([[0.0, 0, 3.0]])]))
    vertices, faces = icosphere(1)
    corners = [0.5 * vertices.float()[faces], shard(0, 0, 0, 0.1), shard(0, 3, 0, 0.1), shard(0, 0, 1.3, 0.015)]
    scene = torch.cat(corners)
    colors = torch.full((len(scene), 3), 0.5)
    soup = TriangleSoup.from_triangles(scene, colors, opacity=0.98, sigma=0.02, sh_degree=1)
    sky = Surroundings.of(capture).soup(capture, 1)
    sky.opacity_logits.data[:] = 3.0
    sky.vertices.data[:] *= 1.01  # as training moves them
    return SoupRun(Path("run"), soup.joined(sky), replace(capture, exact_points=capture.exact_points))


@pytest.mark.parametrize("opaque", [False, True])
def test_cleaning_leaves_out_exactly_what_no_photo_frames_what_none_shows_and_what_stands_alone(
    run: SoupRun, opaque: bool
) -> None:
    """Drawn soft or opaque. The sky stays, as far as it is from everything."""
    found = select(run, clean=True, opaque=opaque)
    assert found.removed == {"frame": 1, "unseen": 1, "alone": 1}
    assert (~found.kept).nonzero()[:, 0].tolist() == [HIDDEN, ABOVE, LONE]
    assert len(found.of(run.soup)) == len(run.soup) - 3
    in_order = {"frame": 1, "unseen": 1200}
    assert in_words(in_order) == "1 out of every photo's frame, 1,200 shown by too few photos"  # type: ignore[arg-type]


def test_what_stands_alone_stays_where_most_photos_show_it(run: SoupRun) -> None:
    """Larger, it is a bird in the air."""
    run.soup.vertices.data[LONE] = shard(0, 0, 1.1, 0.2)[0]
    found = select(run, clean=True, opaque=True)
    assert bool(found.kept[LONE])
    assert "alone" not in found.removed


def test_one_photo_is_enough_for_what_is_opaque_and_of_many_two_for_what_is_soft(
    run: SoupRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is opaque may be smaller than a pixel. Here only the first photo shows what is in the air."""
    assert run.capture is not None
    shown = times_shown(run.soup, training_cameras(run.capture), torch.ones(len(run.soup), dtype=torch.bool))
    assert shown[[HIDDEN, ABOVE, LONE]].tolist() == [0, 0, 1]
    assert int(shown[:BALL].min()) >= 2
    angles = torch.arange(1, 18) * (2 * torch.pi / 18)
    eyes = torch.stack([2.5 * angles.sin(), (-1.0) ** torch.arange(17), 2.5 * angles.cos()], dim=1)
    many = replace(run, capture=capture_of(torch.cat([torch.tensor([[0.0, 0, 1.5]]), eyes])))
    assert select(many, clean=True, opaque=True).removed["unseen"] == 1
    monkeypatch.setattr(soup_selection, "times_shown", lambda soup, *_: torch.ones(len(soup), dtype=torch.int64))
    assert "unseen" not in select(many, clean=True, opaque=True).removed
    assert "unseen" not in select(run, clean=True).removed
    assert not bool(select(many, clean=True).kept[:BALL].any())


def test_each_triangle_counts_for_the_first_reason(run: SoupRun) -> None:
    """Faint, sky, crop, and then what cleaning leaves out."""
    run.soup.opacity_logits.data[ABOVE] = -3.0
    found = select(run, crop=Sphere((0.0, 0.0, 0.0), 1.2), clean=True, sky=False, min_opacity=0.5, opaque=True)
    assert found.removed == {"faint": 1, "sky": SPHERE_TRIANGLES, "crop": 1, "unseen": 1}
    assert list(found.removed) == ["faint", "sky", "crop", "unseen"]
    assert int(found.kept.sum()) == BALL
    assert int(found.sky.sum()) == SPHERE_TRIANGLES


def test_a_crop_keeps_triangles_by_their_centroid(run: SoupRun) -> None:
    """Also where corners are outside; the sky is nothing special."""
    kept = select(run, crop=Box((-9.0, -9.0, 0.0), (9.0, 9.0, 9.0))).kept
    middle = run.soup.vertices.detach().mean(dim=1)
    assert torch.equal(kept, (middle[:, 2] >= 0) & (middle.abs() <= 9).all(dim=1))
    assert bool((run.soup.vertices.detach()[kept][:, :, 2] < 0).any())


def test_crop_auto_is_what_the_photos_look_at(run: SoupRun) -> None:
    """Around the capture's points; without any, around what is opaque and not sky."""
    found = select(run, crop="auto")
    assert isinstance(found.crop, Sphere)
    assert found.crop.radius == pytest.approx(0.55, rel=0.01)
    assert found.kept[:BALL].all()
    assert not bool(found.kept[ABOVE:].any())
    assert run.capture is not None
    bare = replace(run, capture=replace(run.capture, exact_points=None, point_colors=None))
    pointless = select(bare, crop="auto")
    assert isinstance(pointless.crop, Sphere)
    assert pointless.crop.radius == pytest.approx(0.55, rel=0.2)


def test_the_sky_of_a_soup_is_where_its_notes_say(run: SoupRun) -> None:
    """With or without its capture, which otherwise tells where it would be; `none` means none."""
    assert run.capture is not None
    told = Surroundings.of(run.capture)
    noted = replace(run.soup, notes={Surroundings.NOTE: told.note})
    alone = SoupRun(run.path, noted, None)
    found = surroundings_of(alone)
    assert found is not None
    assert (found.middle.float().tolist(), found.radius) == (told.middle.tolist(), told.radius)
    assert select(alone, sky=False).removed == {"sky": SPHERE_TRIANGLES}
    assert select(run, sky=False).removed == {"sky": SPHERE_TRIANGLES}
    assert select(replace(run, capture=None), sky=False).removed == {}
    without = replace(run, soup=replace(run.soup, notes={Surroundings.NOTE: "none"}))
    assert select(without, sky=False).removed == {}
    pointless = replace(run.capture, exact_points=None, point_colors=None)
    assert surroundings_of(replace(run, capture=pointless)) is None


def test_where_nothing_is_left_the_error_says_why(run: SoupRun) -> None:
    with pytest.raises(InputError, match=r"nothing is left of it \(403 outside of the crop\); choose another crop, in"):
        select(run, crop=Sphere((500.0, 0.0, 0.0), 1.0))
    with pytest.raises(InputError, match="no triangle is opaque enough; lower min_opacity"):
        select(run, min_opacity=1.0)
    with pytest.raises(InputError, match="name the scene's folder with scene="):
        select(replace(run, capture=None), clean=True)
    with pytest.raises(InputError, match="name the scene's folder with scene="):
        select(replace(run, capture=None), crop="auto")
