"""Blocks of the pool (csrc/cpu/pool.h): who gets which again, and which go."""

from etsplat import _native
from etsplat.engines.native.pool import empty_image

LARGE = 25 << 20  # floats, of 100 MiB; none is written, so none takes memory


def used(count: int) -> int:
    """Where a block is that is taken and given back."""
    return empty_image(count).data_ptr()


def test_a_block_that_is_used_stays_however_many_others_are_left_behind():
    """As while triangles multiply, every so many steps: then all their sizes are new, those of the pictures are not."""
    first = used(LARGE)
    for number in range(300):
        used((1 << 20) + 2000 * number)
        assert all(used(LARGE) == first for _ in range(50))
    assert _native.pool_idle_bytes() <= 256 << 20


def test_blocks_that_nobody_asks_for_again_go():
    for number in range(40):
        used((1 << 20) + 100_000 * number)
    for _ in range(2000):
        used(1 << 16)
    assert _native.pool_idle_bytes() == 4 << 16


def test_a_block_serves_who_needs_a_little_less():
    """Lists of triangles and tiles are hardly ever as long as in the step before."""
    count = 3_000_000
    first = used(count)
    assert used(count - count // 10) == first
    assert used(count) == first
    assert used(count // 2) != first
    held = empty_image(count)
    assert held.shape == (count,)
    assert held.data_ptr() == first
