"""Paths are made of the cameras that there are."""

import math

import pytest
import torch

from etsplat import look_at, orbit_cameras
from etsplat.core.cameras import camera_centers
from etsplat.data.camera_coverage import focus_point
from etsplat.data.camera_paths import PATHS, path_note, played, usual_frames
from etsplat.data.camera_tour import splined

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
@pytest.mark.parametrize(
    ("odd", "text"),
    [
        ({"viewmats": torch.zeros(0, 4, 4)}, "viewmats must hold at least one camera"),
        ({"viewmats": torch.eye(4)}, "viewmats must have shape"),
        ({"viewmats": torch.full((2, 4, 4), math.nan)}, "viewmats must be finite"),
        ({"viewmats": torch.ones(2, 4, 4).bool()}, "viewmats must be of floating-point numbers"),
        ({"up": torch.ones(2)}, "up must have shape"),
        ({"up": (0, 1, 0)}, "up must be a tensor"),
        ({"frames": 0}, "frames must be an integer from 1 to 1000000, got 0"),
        ({"frames": 2**40}, "frames must be an integer from 1"),
        ({"frames": None}, "frames must be an integer from 1"),
    ],
)
def test_arguments_that_make_no_path_are_refused_by_name(path, odd, text):
    views = orbit_cameras(9, 8, azimuths=2).viewmats
    with pytest.raises(ValueError, match=text):
        path(**{"viewmats": views, "up": torch.tensor([0.0, 1.0, 0.0]), "frames": 5, **odd})


def standing_at(degrees, target=(0.0, 0.0, 0.0), radius=3.0, height=0.5):
    """Cameras on a circle about the origin at some azimuths, looking at a target."""
    turn = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    eyes = torch.stack([radius * turn.cos(), torch.full_like(turn, height), radius * turn.sin()], dim=1)
    return look_at(eyes, torch.tensor(target, dtype=torch.float64), UP)


def front(count=25, width=6.0, depth=4.0):
    """Cameras in a line before a front at z = 0, looking a little inwards."""
    x = torch.linspace(-width / 2, width / 2, count, dtype=torch.float64)
    flat = torch.zeros_like(x)
    return look_at(torch.stack([x, flat, flat + depth], dim=1), torch.stack([0.3 * x, flat, flat], dim=1), UP)


def cluster(count=12):
    rng = torch.Generator().manual_seed(3)
    eyes = torch.randn(count, 3, generator=rng, dtype=torch.float64) * 0.2 + torch.tensor([0.0, 0.0, 4.0])
    return look_at(eyes, torch.zeros(3, dtype=torch.float64), UP)


def above_ground(count=80):
    """Cameras that stand anywhere on a hemisphere, in no order."""
    rng = torch.Generator().manual_seed(4)
    eyes = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng, dtype=torch.float64), dim=1)
    eyes[:, 1] = eyes[:, 1].abs()
    return look_at(3 * eyes, torch.zeros(3, dtype=torch.float64), UP)


RING = list(range(0, 360, 15))
CAPTURES = {
    "ring": standing_at(RING),
    "two rings": torch.cat([standing_at(RING, height=0.2), standing_at(RING, height=2.0, radius=2.5)]),
    "half ring": standing_at(list(range(20, 201, 15))),
    "front": front(),
    "cluster": cluster(),
    "two sides": standing_at([0, 10, 20, 30, 40, 170, 180, 190]),
    "hemisphere": above_ground(),
}


def nearest(path, viewmats):
    """For each frame the distance to the nearest camera, and the angle in degrees to the nearest of the five there."""
    apart = torch.cdist(camera_centers(path), camera_centers(viewmats))
    near = apart.topk(min(5, len(viewmats)), largest=False).indices
    cosine = (path[:, None, 2, :3] * viewmats[near][:, :, 2, :3]).sum(dim=-1)
    return apart.min(dim=1).values, torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))).min(dim=1).values


@pytest.mark.parametrize("name", list(CAPTURES))
@pytest.mark.parametrize("kind", ["photos", "orbit", "ellipse"])
def test_every_frame_is_near_a_photo_and_looks_as_it_does(kind, name):
    """Within a third of their distance from what they show, and 30 degrees."""
    viewmats = CAPTURES[name]
    path = PATHS[kind](viewmats, UP, 60)
    far = (camera_centers(viewmats) - focus_point(viewmats)).norm(dim=1).median()
    distance, angle = nearest(path, viewmats)
    assert float(distance.max()) < far / 3
    assert float(angle.max()) < 30
    rotation = path[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(60, 3, 3))


@pytest.mark.parametrize(
    ("name", "degrees"), [("ring", None), ("two rings", None), ("half ring", 180), ("front", 55), ("two sides", 40)]
)
def test_an_orbit_goes_as_far_round_as_the_photos_and_says_so(name, degrees):
    viewmats = CAPTURES[name]
    for kind in ("orbit", "ellipse"):
        path, note = PATHS[kind](viewmats, UP, 200), path_note(kind, viewmats, UP)
        offsets = camera_centers(path) - focus_point(viewmats)
        azimuths = torch.rad2deg(torch.atan2(offsets[:, 2], offsets[:, 0]))
        turned = torch.remainder(azimuths - azimuths[0] + 180, 360) - 180
        if degrees is None:
            assert note is None
            assert float(azimuths.sort().values.diff().max()) < 10
            continue
        assert note == f"{kind}: the photos go {degrees} degrees round what they show; so does the path, there and back"
        assert float(turned.max() - turned.min()) == pytest.approx(0.9 * degrees, abs=1.5)
        assert float((turned[0] - turned[-1]).abs()) < 2  # it ends where it began


def test_photos_that_look_outwards_have_no_orbit_and_are_followed():
    """As those of a room taken from its middle."""
    turn = torch.deg2rad(torch.arange(0, 360, 20, dtype=torch.float64))
    out = torch.stack([turn.cos(), 0 * turn, turn.sin()], dim=1)
    viewmats = look_at(0.2 * out, 5 * out, UP)
    torch.testing.assert_close(PATHS["orbit"](viewmats, UP, 30), PATHS["photos"](viewmats, UP, 30))
    assert "do not look at one place" in path_note("orbit", viewmats, UP)
    assert not PATHS["photos"](viewmats.clone().requires_grad_(), UP, 30).requires_grad


def test_photos_on_the_way_to_a_door_have_no_orbit_either():
    """All from one side, but for a stray one."""
    way = torch.linspace(2, 9, 20, dtype=torch.float64)[:, None] * torch.tensor([0.0, 0.2, 1.0], dtype=torch.float64)
    viewmats = torch.cat([look_at(way, torch.zeros(3, dtype=torch.float64), UP), standing_at([40], radius=12)])
    assert "do not look at one place" in path_note("orbit", viewmats, UP)
    assert float(nearest(PATHS["orbit"](viewmats, UP, 30), viewmats)[0].max()) < 0.5


def test_a_stray_photo_does_not_widen_the_arc():
    note = path_note("orbit", standing_at([*range(0, 61, 3), 100]), UP)
    assert note == "orbit: the photos go 60 degrees round what they show; so does the path, there and back"


def test_photos_are_followed_in_their_order_where_that_is_a_way():
    """At even speed, from the first to the last; shaking of the hand is gone."""
    viewmats = front(60)
    shaken = viewmats.clone()
    shaken[:, :3, 3] += 0.02 * torch.randn(60, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    path = camera_centers(PATHS["photos"](shaken, UP, 100))
    steps = path.diff(dim=0)
    assert bool((steps[:, 0] > 0).all())
    assert float(steps.norm(dim=1).max()) < 1.3 * float(steps.norm(dim=1).min())
    assert float(steps.diff(dim=0).norm(dim=1).max()) < 0.2 * float(steps.norm(dim=1).mean())


def test_photos_in_no_order_are_followed_along_a_short_way():
    """Not from side to side: a tour of mixed photos is hardly longer than one of ordered ones."""
    mixed = torch.randperm(len(RING), generator=torch.Generator().manual_seed(5))
    lengths = [
        float(camera_centers(PATHS["photos"](viewmats, UP, 400)).diff(dim=0).norm(dim=1).sum())
        for viewmats in (CAPTURES["ring"], CAPTURES["ring"][mixed])
    ]
    assert lengths[1] < 1.2 * lengths[0]


def test_a_jump_between_two_walks_leads_past_other_photos():
    """And not through what they show: the second walk begins where the first one did, on the other side."""
    first, second = list(range(0, 181, 10)), [degrees + 5 for degrees in range(0, 181, 10)]
    viewmats = standing_at([*first, *second])
    path = camera_centers(PATHS["photos"](viewmats, UP, 300))
    assert float(path.norm(dim=1).min()) > 2.7


def test_photos_that_stand_apart_are_left_out_and_that_is_told():
    """Between two sides no photo shows what lies behind the corner; where all are as far apart, they are one group."""
    assert path_note("photos", CAPTURES["two sides"], UP) == (
        "photos: 3 photos stand apart from the others, and the path leaves that out"
    )
    assert "1 photo stands apart" in path_note("photos", standing_at([0, 10, 20, 30, 40, 170]), UP)
    assert path_note("photos", standing_at([0, 90, 180, 270]), UP) is None
    assert path_note("spiral", CAPTURES["two sides"], UP) is None


def test_steps_that_are_lost_beside_a_long_one_take_no_time():
    """Three cameras, the last two so near each other that the sum of steps does not show it."""
    viewmats = torch.eye(4).repeat(3, 1, 1).double()
    viewmats[1:, 0, 3] = -1.0
    positions, rotations = splined(viewmats, torch.tensor([1e20, 1e-9], dtype=torch.float64), 5)
    assert positions.isfinite().all()
    assert positions[[0, -1], 0].tolist() == [0.0, 1.0]
    assert torch.equal(rotations, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))


def test_a_path_along_photos_has_as_many_frames_as_keep_it_calm():
    assert usual_frames("photos", cluster()) == usual_frames("orbit", CAPTURES["ring"]) == 120
    assert 150 < usual_frames("photos", CAPTURES["ring"]) < usual_frames("photos", CAPTURES["two rings"]) <= 480


def test_key_poses_are_gone_through_with_their_fields_of_view():
    keys, fovs = standing_at([0, 40, 60]), torch.tensor([40.0, 50.0, 60.0])
    path, told = played(keys, fovs, 61)
    torch.testing.assert_close(path[[0, -1]], keys[[0, -1]], atol=1e-9, rtol=0)
    assert float(torch.cdist(camera_centers(path), camera_centers(keys))[:, 1].min()) < 0.05
    assert (float(told[0]), float(told[-1])) == (40.0, 60.0)
    assert bool((told.diff() > 0).all())
    still, told = played(keys[:1], fovs[:1], 5)
    assert still.shape == (5, 4, 4)
    assert told.tolist() == [40.0] * 5
