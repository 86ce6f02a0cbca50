"""Whole-file mutations: what is left is often still a file of its kind, so that readers get past its first lines."""

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence

import numpy as np

NUMBERS = [
    *(b"-1", b"0", b"1", b"2", b"3", b"7", b"255", b"256", b"65536", b"2147483647", b"2147483648", b"4294967295"),
    *(b"-2147483649", b"9223372036854775807", b"9223372036854775808", b"18446744073709551616", b"9" * 400, b"1e308"),
    *(b"-1e308", b"1e39", b"1e999", b"1e-320", b"nan", b"NaN", b"inf", b"-Infinity", b"0x10", b"1_0", b"0.5", b"-0.0"),
    *(b"3.7", b"+4", b"1.", b".5", b"--1", b"1e", "٣".encode()),
]
WORDS = [
    *(b"", b"null", b"true", b"[]", b"{}", b'""', b'"/"', b'"../../x"', b'"a\\u0000b"', b'"\\ud800"', b"red", b"float"),
    *(
        b"uchar",
        b"double",
        b"list",
        b"PINHOLE",
        b"#",
        b"\x00",
        b"\xff\xfe",
        "é".encode(),
        b"-",
        b"/",
        b"%s",
        b"e" * 300,
    ),
]
INTEGERS = (-1, 0, 1, 2, 3, 255, 65535, 10**6, 2**28, 2**31 - 1, -(2**31), 2**32 - 1, 2**32, 2**62, 2**63, 2**64 - 1)
FLOATS = (float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 1e38, 5e-324, 0.0, -1.0, 0.5)

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_TOKEN = re.compile(_NUMBER.pattern + rb"|[A-Za-z_][A-Za-z_0-9]*|\"[^\"]*\"")

Parts = tuple[list[bytes], Callable[[list[bytes]], bytes]]
"""The insides of a container, and what makes one of them again, with lengths and checksums that fit."""


def mutated(data: bytes, rng: np.random.Generator, others: Sequence[bytes]) -> bytes:
    """The file with a few places changed; `others` are files of the same kind, pieces of which may come in."""
    parts = _parts_of(data) if rng.random() < 0.6 else None
    if parts is None:
        return _changed(data, rng, others)
    pieces, joined = parts
    chosen = int(rng.integers(len(pieces)))
    pieces[chosen] = _changed(pieces[chosen], rng, others)
    return joined(pieces)


def _changed(data: bytes, rng: np.random.Generator, others: Sequence[bytes]) -> bytes:
    changes = int(rng.choice((1, 1, 1, 2, 4)))
    for _ in range(changes):
        if not data:
            return data
        text = b"\0" not in data[:200] and max(data[:200]) < 128
        data = _change_text(data, rng) if text and rng.random() < 0.75 else _change_bytes(data, rng, others)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Anywhere, or among the first bytes, where headers are."""
    return int(rng.integers(len(data) if rng.random() < 0.6 else min(len(data), 200)))


def _change_text(data: bytes, rng: np.random.Generator) -> bytes:
    kind = rng.random()
    if kind < 0.7:
        at = _place(data, rng)
        found = _NUMBER.search(data, at) if rng.random() < 0.6 else None
        found = found or _TOKEN.search(data, at) or _TOKEN.search(data)
        if found is None:
            return data + b" 1"
        is_number = found[0][:1] in b"+-0123456789"
        if is_number and kind < 0.3:  # another digit
            digit = int(rng.integers(len(found[0])))
            put = found[0][:digit] + str(int(rng.integers(10))).encode() + found[0][digit + 1 :]
        elif kind < 0.4:  # two words change places
            other = _TOKEN.search(data, _place(data, rng))
            put = found[0] if other is None else other[0]
        else:
            choices = NUMBERS if is_number == (rng.random() < 0.9) else WORDS
            put = choices[int(rng.integers(len(choices)))]
        return data[: found.start()] + put + data[found.end() :]
    lines = data.split(b"\n")
    one, other = (int(rng.integers(len(lines))) for _ in range(2))
    if kind < 0.8:
        lines[one], lines[other] = lines[other], lines[one]
    elif kind < 0.9:
        lines.insert(one, lines[other])
    else:
        del lines[one]
    return b"\n".join(lines)


def _change_bytes(data: bytes, rng: np.random.Generator, others: Sequence[bytes]) -> bytes:
    at, kind = _place(data, rng), rng.random()
    if kind < 0.4:
        return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
    if kind < 0.5:
        return data[:at] + bytes([int(rng.choice((0, 255, 127, 128, 10, 32)))]) + data[at + 1 :]
    if kind < 0.7:
        at -= at % 4
        layout = str(rng.choice(("<I", "<Q", ">I", "<H")))
        size = struct.calcsize(layout)
        number = INTEGERS[int(rng.integers(len(INTEGERS)))] % (1 << 8 * size)
        return data[:at] + struct.pack(layout, number) + data[at + size :]
    if kind < 0.8:
        at -= at % 4
        number = FLOATS[int(rng.integers(len(FLOATS)))]
        with np.errstate(over="ignore"):
            put = struct.pack("<d", number) if rng.random() < 0.3 else np.float32(number).tobytes()
        return data[:at] + put + data[at + len(put) :]
    length = int(rng.choice((1, 2, 4, 16, 64)))
    if kind < 0.88:
        return data[:at] + data[at + length :]
    if kind < 0.92:
        return data[:at]
    other = others[int(rng.integers(len(others)))] or data
    start = int(rng.integers(len(other)))
    return data[:at] + other[start : start + length] + data[at + (length if kind < 0.96 else 0) :]


def _parts_of(data: bytes) -> Parts | None:
    """Of GLB, safetensors, PNG, compact soups, zip files (torch's are some); None for all else and what is damaged."""
    try:
        if data[:4] == b"glTF":
            return _glb(data)
        if data[:4] == b"PK\3\4":
            return _zip(data)
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            return _png(data)
        if data[:4] == b"ETSZ":
            return _compact(data)
        if len(data) > 10 and data[8:9] == b"{":
            return _safetensors(data)
    except (struct.error, zipfile.BadZipFile, zlib.error, ValueError, KeyError, NotImplementedError, EOFError):
        pass
    return None


def _glb(data: bytes) -> Parts:
    length = struct.unpack_from("<I", data, 12)[0]
    text, rest = data[20 : 20 + length], data[20 + length :]

    def joined(parts: list[bytes]) -> bytes:
        document = parts[0] + b" " * (-len(parts[0]) % 4)
        body = struct.pack("<I4s", len(document), b"JSON") + document + parts[1]
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    return [text, rest], joined


def _safetensors(data: bytes) -> Parts:
    length = struct.unpack_from("<Q", data)[0]
    text, rest = data[8 : 8 + length], data[8 + length :]
    json.loads(text)

    def joined(parts: list[bytes]) -> bytes:
        return struct.pack("<Q", len(parts[0])) + parts[0] + parts[1]

    return [text, rest], joined


def _png(data: bytes) -> Parts:
    kinds, contents, at = [], [], 8
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        kinds.append(kind)
        contents.append(
            zlib.decompress(data[at + 8 : at + 8 + size]) if kind == b"IDAT" else data[at + 8 : at + 8 + size]
        )
        at += 12 + size

    def joined(parts: list[bytes]) -> bytes:
        found = [data[:8]]
        for kind, part in zip(kinds, parts, strict=True):
            content = zlib.compress(part) if kind == b"IDAT" else part
            found.append(
                struct.pack(">I4s", len(content), kind) + content + struct.pack(">I", zlib.crc32(kind + content))
            )
        return b"".join(found)

    return contents, joined


def _compact(data: bytes) -> Parts:
    """The header, and what each chunk inflates to."""
    length = struct.unpack_from("<I", data, 8)[0]
    text, at, chunks = data[12 : 12 + length], 12 + length, []
    for _, size in json.loads(text)["chunks"]:
        chunks.append(zlib.decompress(data[at : at + size]))
        at += size

    def joined(parts: list[bytes]) -> bytes:
        header, packed = parts[0], [zlib.compress(part) for part in parts[1:]]
        if header == text:
            document = json.loads(text)
            counts = [count for count, _ in document["chunks"]]
            document["chunks"] = [[count, len(part)] for count, part in zip(counts, packed, strict=True)]
            header = json.dumps(document).encode()
        else:
            packed = [data[12 + length :]]
        return data[:8] + struct.pack("<I", len(header)) + header + b"".join(packed)

    return [text, *chunks], joined


def _zip(data: bytes) -> Parts:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = archive.namelist()
        contents = [archive.read(name) for name in names]

    def joined(parts: list[bytes]) -> bytes:
        memory = io.BytesIO()
        with zipfile.ZipFile(memory, "w") as archive:
            for name, part in zip(names, parts, strict=True):
                archive.writestr(name, part)
        return memory.getvalue()

    return contents, joined
