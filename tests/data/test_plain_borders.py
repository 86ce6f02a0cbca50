"""Borders of masks are mended by colours before what is plain, and nowhere else."""

import numpy as np
import pytest

from etsplat.data.plain_borders import at_plain_borders

SIDE = 160
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE]
DISC = np.hypot(ROWS - 80, COLUMNS - 80) < 40


def picture(background, object_color=(0.2, 0.3, 0.7)):
    """A disc with some noise before a background."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.008, (SIDE, SIDE, 3))
    return (np.where(DISC[..., None], object_color, background) + noise).clip(0, 1)


def iou(mask):
    return (mask & DISC).sum() / (mask | DISC).sum()


WHITE = np.full((SIDE, SIDE, 3), 0.85) - 0.05 * (COLUMNS / SIDE)[..., None]
CHECKS = np.where(((ROWS // 6 + COLUMNS // 6) % 2 == 0)[..., None], [0.85] * 3, [0.4] * 3)


@pytest.mark.parametrize("wrong", [np.hypot(ROWS - 80, COLUMNS - 80) < 43, np.hypot(ROWS - 81, COLUMNS - 80) < 39])
def test_before_white_with_a_shade_the_border_is_where_colours_change(wrong):
    """Three pixels too wide; a pixel too narrow, and moved by one."""
    assert iou(wrong) < 0.96
    assert iou(at_plain_borders(wrong, picture(WHITE))) > 0.985


@pytest.mark.parametrize("wrong", [np.hypot(ROWS - 80, COLUMNS - 80) < 43, np.hypot(ROWS - 81, COLUMNS - 80) < 39])
def test_before_a_pattern_masks_stay_as_depths_have_them(wrong):
    assert (at_plain_borders(wrong, picture(CHECKS)) == wrong).all()


def test_an_object_of_the_same_colour_stays_as_depths_have_it():
    wrong = np.hypot(ROWS - 81, COLUMNS - 80) < 39
    assert (at_plain_borders(wrong, picture(WHITE, WHITE)) == wrong).mean() > 0.999
