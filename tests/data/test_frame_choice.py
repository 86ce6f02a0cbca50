"""Which frames of a video are taken."""

import numpy as np
import pytest

from etsplat.core.errors import InputError
from etsplat.data.frame_choice import Measured, choose_frames, measure_frames
from helpers.videos import pan


def measured(places, blurred=()):
    return measure_frames(frame[..., 0] for frame in pan(places, blurred))


def test_motion_is_measured_in_parts_of_the_picture():
    """A pan by one pixel from frame to frame of 160 is one in 160; noise on a still camera is nothing."""
    motion = measured(range(0, 30, 1)).motion
    assert motion[0] == 0
    assert motion[1:].mean() == pytest.approx(1 / 160, rel=0.2)
    rng, still = np.random.default_rng(0), pan([0])[0][..., 0].astype(float)
    noisy = [np.clip(still + rng.normal(0, 4, still.shape), 0, 255).astype(np.uint8) for _ in range(20)]
    with pytest.raises(InputError, match="hardly moves in 20 frames"):
        choose_frames(measure_frames(noisy), 5)


def test_among_neighbours_the_sharpest_is_chosen():
    """Of every four frames three are blurred: none of these is chosen."""
    sharp = set(range(0, 120, 4))
    chosen = choose_frames(measured(range(120), blurred=set(range(120)) - sharp), 10)
    assert len(chosen) == 10
    assert set(chosen) <= sharp


def test_frames_are_spread_over_what_moves_not_over_time():
    """A camera that stands still for half of the time gives one frame of that time; steps are half a part at least."""
    places = [*range(60), *[60] * 120, *range(60, 120)]
    chosen = choose_frames(measured(places), 12)
    assert sum(60 <= number < 180 for number in chosen) <= 1
    steps = np.diff(np.array(places)[chosen])
    assert steps.min() >= 120 / 12 / 2 - 1
    assert steps.max() <= 2 * 120 / 12


def test_no_more_frames_are_chosen_than_show_something_new():
    """100 pixels of 160 are 62 steps of a hundredth; one jump is at most one frame."""
    assert 40 < len(choose_frames(measured(range(100)), 1000)) <= 70
    jump = Measured(np.ones(4), np.array([0, 0.01, 0.5, 0.01]))
    chosen = choose_frames(jump, 10)
    assert chosen == sorted(set(chosen))
    assert len(chosen) <= 3
