"""Depth maps that contradict what is known are left out; what is decided lasts over a checkpoint."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.loader import ViewLoader
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.depth_trust import DepthTrust
from helpers.depths import ball_with_depths


def pairs(change, views=6):
    rng = torch.Generator().manual_seed(0)
    depths = {view: 2 + 2 * torch.rand(200, generator=rng) for view in range(views)}
    return {view: (depth, change(depth, view)) for view, depth in depths.items()}


def believed(trust, views=6):
    return [float(trust.believed(torch.tensor([view]))) for view in range(views)]


def test_right_maps_are_believed_as_depths_and_wrong_ones_among_them_are_not():
    told = []
    trust = DepthTrust(range(6), tell=told.append)
    trust.judge(pairs(lambda depth, view: depth.flip(0) if view == 2 else depth), "the truth")
    assert trust.kind == "l1"
    assert believed(trust) == [1, 1, 0, 1, 1, 1]
    assert told == ["depth maps: 5 of 6 used as depths; 100 % of the truth explained"]
    assert trust.metrics() == {"depth_used": "l1", "depth_photos": 5, "depth_explained": 1.0}


def test_maps_in_another_unit_are_believed_up_to_scale_and_the_factor_is_told():
    told = []
    trust = DepthTrust(range(6), tell=told.append)
    trust.judge(pairs(lambda depth, _: depth / 4), "the truth")
    assert trust.kind == "pearson"
    assert "the truth is 4 times as far away: correct the unit with depth_unit=" in told[0]
    asked = DepthTrust(range(6), "l1")
    asked.judge(pairs(lambda depth, _: depth / 4), "the truth")
    assert asked.kind is None


def test_maps_in_a_unit_that_is_found_are_believed_as_depths():
    """Unless what they are compared with has another one, or they are asked to count up to scale."""
    told = []
    wrong = pairs(lambda depth, _: depth / 4)
    trust = DepthTrust(range(6), tell=told.append, unit_near=lambda factor: 1.001 * factor)
    trust.judge(wrong, "the truth")
    assert trust.kind == "l1"
    assert trust.unit == pytest.approx(4.004)
    assert "4.004 times as far away, where maps agree: they are multiplied by it" in told[0]
    assert trust.metrics()["depth_factor"] == trust.unit
    again = DepthTrust(range(6))
    again.load_state(trust.state())
    assert again.unit == trust.unit
    for choice, found in (("auto", 1.1), ("pearson", 1.0), ("auto", None)):
        other = DepthTrust(range(6), choice, unit_near=lambda factor, by=found: by and by * factor)
        other.judge(wrong, "the truth")
        assert (other.kind, other.unit) == ("pearson", 1)


def test_inverse_depths_are_believed_as_such():
    trust = DepthTrust(range(6))
    trust.judge(pairs(lambda depth, _: 0.1 + 3 / depth), "the truth")
    assert (trust.kind, trust.inverse) == ("pearson", True)
    assert trust.metrics()["depth_used"] == "inverse pearson"


def test_garbage_is_not_believed():
    told = []
    trust = DepthTrust(range(6), tell=told.append)
    assert not trust.judge(pairs(lambda depth, _: depth.flip(0)), "the truth")
    assert trust.kind is None
    assert trust.photos == 0
    assert told[0].startswith("depth maps: not used, they contradict the truth (")


def test_maps_fall_away_where_photos_kept_aside_get_worse():
    told = []
    trust = DepthTrust(range(6), tell=told.append)
    trust.judge(pairs(lambda depth, _: depth), "the truth")
    for psnr in (20.0, 22.0, 21.7):
        trust.observe(psnr)
    assert trust.kind == "l1"
    trust.observe(21.4)
    assert trust.kind is None
    assert "fell from 22.00 to 21.40 dB" in told[-1]
    assert trust.metrics()["depth_used"] is None


def test_what_is_decided_lasts_over_a_checkpoint():
    trust, again = DepthTrust(range(6)), DepthTrust(range(6), measured_at=10)
    assert again.state() == {}
    trust.judge(pairs(lambda depth, view: depth.flip(0) if view == 2 else 1 / depth), "the truth")
    again.load_state(trust.state())
    assert (again.kind, again.inverse, again.explained) == (trust.kind, True, trust.explained)
    assert believed(again) == believed(trust)
    again.load_state({})
    assert again.kind is None


@pytest.mark.parametrize("wrong", [False, True])
def test_maps_are_compared_with_the_model(engine, wrong):
    """With a ball that is where photos show it."""
    ball = ball_with_depths(change=lambda depth, view: depth.flip(1) * (1 + 0.3 * depth.flip(0)) if wrong else depth)
    vertices, faces = icosphere(3)
    mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.5, opacity=0.98, sigma=0.05)
    loader, trust = ViewLoader(ball, torch.device("cpu")), DepthTrust(ball.train)
    trust.measure(mesh, (loader.view(view) for view in ball.train[:4]))
    assert (trust.kind == "l1") == (not wrong)


def test_depths_come_in_units_of_the_frame():
    """By index and by place; halved photos have halved maps, and views without a map none."""
    ball = ball_with_depths()
    maps = [ball.images.depth(view) if view else None for view in range(len(ball))]
    ball = replace(ball, images=StoredPictures(list(ball.images), depths=maps))
    moved = ball.renormalized(torch.zeros(3, dtype=torch.float64), 4.0)
    loader = ViewLoader(moved, torch.device("cpu"))
    first = ball.train[3]
    kind, place = loader.kind_and_place(first)
    for view in (loader.view(first), loader.look_up(kind, torch.tensor(place))):
        assert torch.equal(view.depth[0], maps[first] / 4)
    assert ViewLoader(moved, torch.device("cpu")).view(0).depth is None
    small = moved.halved()
    assert small.images.with_depth == frozenset(range(1, len(ball)))
    halved = small.images.depth(first)
    assert halved.shape == (24, 24)
    assert set(halved.unique().tolist()) <= {0.0, *maps[first].unique().tolist()}


def test_a_map_of_another_shape_is_refused():
    ball = ball_with_depths(azimuths=2)
    with pytest.raises(ValueError, match=r"depths\[0\]: expected \(48, 48\), got \(3, 3\)"):
        StoredPictures(list(ball.images), depths=[torch.ones(3, 3)] * len(ball))
