"""Depth maps of a ball, compared with its points and with each other."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.depth_points import maps_on_maps, points_on_maps
from etsplat.data.pictures import StoredPictures
from etsplat.metrics.depth import depth_agreement
from helpers.depths import ball_with_depths


def explained(pairs):
    return depth_agreement(list(pairs.values())).overall("l1")


@pytest.mark.parametrize("radius", [1.0, 7.0])
def test_right_maps_agree_with_points_and_with_each_other(radius):
    """In the frame of the capture and in another; what is hidden behind the ball does not count."""
    ball = ball_with_depths().renormalized(torch.tensor([0.1, 0.2, 0.0], dtype=torch.float64), radius)
    assert explained(points_on_maps(ball, ball.train)) > 0.9
    assert explained(maps_on_maps(ball, ball.train)) > 0.9


def test_maps_in_another_unit_and_those_of_other_photos_disagree():
    ball = ball_with_depths()
    for wrong in ([0.6 * ball.images.depth(v) for v in range(len(ball))], scrambled(ball)):
        pictures = StoredPictures(list(ball.images), depths=wrong)
        assert explained(maps_on_maps(replace(ball, images=pictures), ball.train)) < 0.2


def scrambled(ball):
    """Random surfaces between the nearest and the farthest depth."""
    rng = torch.Generator().manual_seed(0)
    maps = [ball.images.depth(view) for view in range(len(ball))]
    return [torch.where(m > 0, 2 + 2 * torch.rand(m.shape, generator=rng), 0.0) for m in maps]
