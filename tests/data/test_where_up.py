"""Where up is, by how cameras were held and by what says where a capture lies."""

from dataclasses import replace

import pytest
import torch

from etsplat.core.cameras import look_at
from etsplat.data.load import load_dataset
from etsplat.data.where_up import held_up, up_of
from etsplat.io.georeference import Georeference
from helpers.captures import write_colmap

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def test_up_is_what_cameras_are_level_with_although_all_look_up():
    """The mean of their own ups leans back at a front; where they stand side by side nothing else is known."""
    turn = torch.linspace(-0.8, 0.8, 15, dtype=torch.float64)
    eyes = torch.stack([4 * turn.sin(), 0 * turn, 4 * turn.cos()], dim=1)
    around = look_at(eyes, torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64), UP)
    mean = torch.nn.functional.normalize(-around[:, 1, :3].mean(dim=0), dim=0)
    assert float(mean @ UP) < 0.93
    torch.testing.assert_close(held_up(around), UP, atol=1e-6, rtol=0)
    side_by_side = look_at(eyes, eyes + torch.tensor([0.0, 2.0, -4.0], dtype=torch.float64), UP)
    torch.testing.assert_close(held_up(side_by_side), -side_by_side[0, 1, :3])


def test_cameras_that_contradict_each_other_do_not_say_where_up_is():
    eyes = torch.tensor([[3.0, 0, 0], [0, 0, 3.0], [-3.0, 0, 0], [0, 0, -3.0]], dtype=torch.float64)
    held = look_at(eyes, torch.zeros(3), UP)
    torch.testing.assert_close(held_up(held), UP)
    assert held_up(torch.cat([held, look_at(eyes, torch.zeros(3), -UP)])) is None


@pytest.mark.parametrize(("axis", "expected"), [("z", [0.0, 0, 1]), ("y", [0.0, 1, 0])])
def test_what_says_where_a_capture_lies_says_where_up_is(tmp_path, axis, expected):
    """Photos that look straight down have their own up directions along the ground."""
    write_colmap(tmp_path, [(33, 24)] * 9)
    capture = replace(load_dataset(tmp_path), georeference=Georeference(up=axis))
    assert torch.equal(up_of(capture), torch.tensor(expected, dtype=torch.float64))
    unsaid = replace(capture, georeference=Georeference())
    torch.testing.assert_close(up_of(unsaid), held_up(capture.viewmats))
