"""Tables of whole numbers as deflated byte planes: what compact soups are made of (docs/compact_format.md)."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MOST_ROWS = 1 << 16
"""Rows of a chunk."""

MOST_INFLATED = 64
"""What a chunk inflates to has at most so many times its bytes: a file justifies what a reader makes of it."""


@dataclass(frozen=True)
class Channel:
    """Some columns of a table that are stored alike.

    Attributes:
        name: of the columns.
        width: how many there are.
        size: bytes of each number, 1 to 3.
        signed: numbers may be negative; they are stored as 0, -1, 1, -2, 2, ...
        delta: each number is stored as what it differs by from that in the row before, modulo 256^size.
    """

    name: str
    width: int
    size: int
    signed: bool = False
    delta: bool = False

    def stored(self, values: np.ndarray) -> np.ndarray:
        """(n, width) int64 numbers to those that are written, from 0 to 256^size - 1."""
        if self.delta:
            bits = 8 * self.size
            steps = np.diff(values, axis=0, prepend=0) & ((1 << bits) - 1)
            values = np.where(steps >> (bits - 1), steps - (1 << bits), steps)
        return (values << 1) ^ (values >> 63) if self.signed or self.delta else values

    def restored(self, stored: np.ndarray) -> np.ndarray:
        """What `stored` was given."""
        values = (stored >> 1) ^ -(stored & 1) if self.signed or self.delta else stored
        return np.cumsum(values, axis=0) & ((1 << 8 * self.size) - 1) if self.delta else values


def row_bytes(channels: Sequence[Channel]) -> int:
    """Bytes of a row before deflating."""
    return sum(channel.width * channel.size for channel in channels)


def pack_chunk(channels: Sequence[Channel], table: dict[str, np.ndarray]) -> bytes:
    """A chunk: column by column, of each the lowest byte of every row, then the next; deflated, in zlib's wrapping.

    Args:
        channels: what each row has, in this order.
        table: (n, width) whole numbers of each channel, n at most `MOST_ROWS`.
    """
    planes = []
    for channel in channels:
        stored = channel.stored(table[channel.name].astype(np.int64))
        for column in stored.T:
            planes += [((column >> 8 * place) & 255).astype(np.uint8).tobytes() for place in range(channel.size)]
    raw = b"".join(planes)
    deflate = zlib.compressobj(
        9, strategy=zlib.Z_RLE
    )  # planes hold runs of zeros and noise, which nothing else shortens
    packed = deflate.compress(raw) + deflate.flush()
    # What is nearly constant would inflate to more than readers believe.
    return packed if len(raw) <= MOST_INFLATED * len(packed) else zlib.compress(raw, 0)


def unpack_chunk(channels: Sequence[Channel], rows: int, data: bytes) -> dict[str, np.ndarray]:
    """The table that `pack_chunk` was given, int64.

    Raises:
        ValueError: the bytes are not those of so many rows.
    """
    expected = rows * row_bytes(channels)
    if not 0 < rows <= MOST_ROWS or expected > MOST_INFLATED * len(data):
        raise ValueError(f"{len(data)} bytes cannot hold {rows} triangles")
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(data, expected + 1)
    except zlib.error as error:
        raise ValueError(f"a chunk is damaged ({error})") from error
    if len(raw) != expected or not inflate.eof:
        raise ValueError("a chunk is damaged (it has another length than it says)")
    planes = np.frombuffer(raw, np.uint8).reshape(-1, rows)
    table, first = {}, 0
    for channel in channels:
        mine = planes[first : first + channel.width * channel.size].astype(np.int64)
        first += channel.width * channel.size
        places = np.arange(channel.size) * 8
        columns = (mine.reshape(channel.width, channel.size, rows) << places[:, None]).sum(axis=1)
        table[channel.name] = channel.restored(columns.T)
    return table
