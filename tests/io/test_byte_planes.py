"""Whole numbers come back from their planes exactly, and what is none is refused before there is room for it."""

import zlib

import numpy as np
import pytest

from etsplat.io.byte_planes import MOST_INFLATED, MOST_ROWS, Channel, pack_chunk, row_bytes, unpack_chunk

CHANNELS = [
    Channel("walk", 3, 3, delta=True),
    Channel("byte", 1, 1),
    Channel("word", 2, 2),
    Channel("signed", 2, 2, signed=True),
]


def table_of(rows):
    rng = np.random.default_rng(rows)
    return {
        "walk": rng.integers(0, 1 << 24, (rows, 3)),
        "byte": rng.integers(0, 256, (rows, 1)),
        "word": rng.integers(0, 65536, (rows, 2)),
        "signed": rng.integers(-32768, 32768, (rows, 2)),
    }


@pytest.mark.parametrize("rows", [1, 2, 1000])
def test_every_kind_of_number_comes_back(rows):
    table = table_of(rows)
    found = unpack_chunk(CHANNELS, rows, pack_chunk(CHANNELS, table))
    assert all(np.array_equal(found[name], values) for name, values in table.items())


def test_planes_lie_as_the_description_says():
    """Column by column, the low bytes of all rows before the next ones; docs/compact_format.md."""
    channels = [Channel("word", 2, 2), Channel("signed", 1, 1, signed=True), Channel("walk", 1, 1, delta=True)]
    words, signed, walk = np.array([[0x0102, 0x0304], [0x0506, 0x0708]]), np.array([[-1], [3]]), np.array([[5], [2]])
    packed = pack_chunk(channels, {"word": words, "signed": signed, "walk": walk})
    assert zlib.decompress(packed) == bytes([2, 6, 1, 5, 4, 8, 3, 7, 1, 6, 10, 5])


def test_what_is_constant_is_not_taken_for_a_bomb():
    rows = MOST_ROWS
    table = {channel.name: np.zeros((rows, channel.width), np.int64) for channel in CHANNELS}
    data = pack_chunk(CHANNELS, table)
    assert rows * row_bytes(CHANNELS) <= MOST_INFLATED * len(data)
    assert not unpack_chunk(CHANNELS, rows, data)["walk"].any()


def test_chunks_that_are_none_are_refused():
    data = pack_chunk(CHANNELS, table_of(100))
    for rows, changed, message in (
        (99, data, "another length"),
        (101, data, "another length"),
        (100, data[:-5], "another length"),
        (100, b"no zlib" * 100, "damaged"),
        (0, data, "cannot hold"),
        (MOST_ROWS + 1, data * 1000, "cannot hold"),
        (MOST_ROWS, zlib.compress(bytes(MOST_ROWS * row_bytes(CHANNELS)), 9), "cannot hold"),
    ):
        with pytest.raises(ValueError, match=message):
            unpack_chunk(CHANNELS, rows, changed)
