"""Photos of several data sets as those of one."""

import pytest
import torch

from etsplat.data.changed_pictures import Joined
from etsplat.data.pictures import LazyPictures, StoredPictures


def photo(value: int, width: int = 4) -> torch.Tensor:
    return torch.full((3, width, 3), value, dtype=torch.uint8)


def stored(*values: int) -> StoredPictures:
    return StoredPictures([photo(value) for value in values])


def test_joined_photos_are_those_of_the_first_and_then_of_the_second() -> None:
    masked = StoredPictures([photo(7, 5)], masks=[torch.ones(3, 5, dtype=torch.bool)], depths=[torch.ones(3, 5)])
    both = Joined([stored(1, 2), masked])
    assert [int(pixels[0, 0, 0]) for pixels in both] == [1, 2, 7]
    assert both.sizes == [(4, 3), (4, 3), (5, 3)]
    assert both.with_depth == {2}
    assert both.mask(0) is None
    assert both.mask(2) is not None
    assert both.total_bytes == both.held_bytes == stored(1, 2).total_bytes + masked.total_bytes
    assert not both.streamed
    with pytest.raises(IndexError, match="view 3"):
        both.picture(3)


def test_parts_of_joined_photos_keep_their_order() -> None:
    some = Joined([stored(1, 2, 3), stored(7, 8)]).subset([4, 0, 3, 2])
    assert [int(pixels[0, 0, 0]) for pixels in some] == [8, 1, 7, 3]
    assert [int(pixels[0, 0, 0]) for pixels in some.subset([2, 1])] == [7, 1]


def test_joined_photos_are_known_by_what_they_show_and_in_which_order() -> None:
    both = Joined([stored(1, 2), stored(7)])
    assert both.fingerprint() == Joined([stored(1, 2), stored(7)]).fingerprint()
    others = [Joined([stored(1, 2), stored(8)]), Joined([stored(1), stored(2, 7)]), both.subset([1, 0, 2])]
    assert all(other.fingerprint() != both.fingerprint() for other in others)


def test_joined_photos_are_made_when_they_are_needed_by_the_part_that_makes_them() -> None:
    made: list[int] = []

    def make(index: int) -> torch.Tensor:
        made.append(index)
        return photo(index)

    lazy = LazyPictures(make, [(4, 3)] * 3)
    both = Joined([stored(9), lazy])
    both.expect([0, 2])
    assert int(both[2][0, 0, 0]) == 1
    assert made == [1]
    assert both.held_bytes == stored(9).total_bytes + lazy.held_bytes
