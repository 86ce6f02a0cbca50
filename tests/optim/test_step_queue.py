"""The row of a queued step: named numbers that come out as they went in."""

import pytest
import torch

from etsplat.optim.step_queue import RowLayout


def test_groups_come_out_by_name_as_views() -> None:
    """Each with its numbers, in the memory of the row."""
    layout = RowLayout(place=2, none=0, scale=1, rates=3)
    row = torch.tensor(layout.pack(place=(4, 1), none=(), scale=[0.5], rates=[1, 2, 3]))
    assert layout.width == len(row) == 6
    groups = layout.unpack(row)
    assert {name: group.tolist() for name, group in groups.items()} == {
        "place": [4, 1],
        "none": [],
        "scale": [0.5],
        "rates": [1, 2, 3],
    }
    row[2] = 7
    assert groups["scale"].tolist() == [7]


def test_the_order_in_which_groups_are_named_does_not_matter() -> None:
    assert RowLayout(place=2, scale=1).pack(scale=[9], place=[1, 2]) == [1, 2, 9]


@pytest.mark.parametrize("groups", [{"place": (1, 2)}, {"place": (1,), "scale": (1,)}])
def test_a_group_that_is_missing_or_of_another_size_is_refused(groups: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(ValueError, match="groups must be"):
        RowLayout(place=2, scale=1).pack(**groups)
