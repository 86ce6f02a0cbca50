"""Compact soups lose little, draw from any part of them that begins at the start, and damaged ones are refused."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from etsplat.core.errors import InputError
from etsplat.io.compact_soups import CHUNK, CompactSoup, decode_compact, encode_compact, enlargement, read_compact


def soup_of(count, degree=3, seed=0):
    """Small triangles in a room, one in fifty of a sky a thousand times as far away."""
    rng = np.random.default_rng(seed)
    far = np.where(np.arange(count) % 50 == 7, 1000.0, 1.0)
    vertices = (rng.normal(size=(count, 1, 3)) + 0.02 * rng.normal(size=(count, 3, 3))) * far[:, None, None]
    return CompactSoup(
        vertices.astype(np.float32),
        opacities=rng.uniform(size=count).astype(np.float32),
        sigma=np.exp(rng.normal(size=count)).astype(np.float32),
        harmonics=(0.3 * rng.normal(size=(count, (degree + 1) ** 2, 3))).astype(np.float32),
        appearance={"kernel": "elastic", "near_plane": 0.01},
        notes={"focal": "300.0"},
    )


def matched(soup, found):
    """The triangles of `soup` in the order of `found`: chunks are sorted within, so each finds its nearest."""
    order = []
    for start in range(0, len(soup), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(soup)))
        distances = np.abs(soup.vertices[rows][None] - found.vertices[rows][:, None]).max(axis=(2, 3))
        order.append(rows[distances.argmin(axis=1)])
    return np.concatenate(order)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_comes_back_nearly(degree):
    soup = soup_of(300, degree)
    found = decode_compact(encode_compact(soup))
    order = matched(soup, found)
    assert sorted(order) == list(range(300))
    size = np.ptp(soup.vertices, axis=1).max(axis=1)[order]
    assert (np.abs(found.vertices - soup.vertices[order]).max(axis=(1, 2)) < 0.01 * size).all()
    assert np.abs(found.opacities - soup.opacities[order]).max() < 0.5001 / 255
    assert np.abs(np.log(found.sigma / soup.sigma[order])).max() < 0.02
    assert np.abs(found.harmonics - soup.harmonics[order]).max() < 0.5001 / 64
    assert (found.appearance, found.notes, found.left_out) == (soup.appearance, soup.notes, 0)


def test_opaque_triangles_come_back_with_the_colours_of_their_corners():
    colors = np.random.default_rng(1).uniform(size=(300, 3, 3)).astype(np.float32)
    soup = CompactSoup(soup_of(300).vertices, corner_colors=colors)
    found = decode_compact(encode_compact(soup))
    assert np.abs(found.corner_colors - colors[matched(soup, found)]).max() < 0.5001 / 255
    assert found.harmonics is None


def test_one_triangle_and_triangles_without_size_come_back():
    for vertices in (np.ones((1, 3, 3)), np.zeros((3, 3, 3)), np.eye(3)[None] * 1e-20, np.eye(3)[None] * 1e20):
        soup = CompactSoup(vertices.astype(np.float32), corner_colors=np.ones_like(vertices))
        found = decode_compact(encode_compact(soup))
        np.testing.assert_allclose(found.vertices, vertices, rtol=1e-2, atol=1e-3 * np.abs(vertices).max())


def test_numbers_out_of_proportion_widen_the_steps():
    soup = soup_of(10)
    soup.harmonics[3, 7] = 5000.0
    found = decode_compact(encode_compact(soup))
    assert np.abs(found.harmonics).max() == pytest.approx(5000, rel=1e-3)


def test_a_file_that_is_cut_short_draws_its_most_important_triangles(tmp_path):
    soup = soup_of(2 * CHUNK + 100, degree=0)
    data = encode_compact(soup)
    whole, path = decode_compact(data), tmp_path / "soup.etz"
    ends = np.cumsum([start_of(data), *(size for _, size in header_of(data)["chunks"])])
    for cut, kept in ((ends[1], CHUNK), (ends[2] - 1, CHUNK), (ends[2], 2 * CHUNK), (ends[3], 2 * CHUNK + 100)):
        path.write_bytes(data[:cut])
        found = read_compact(path)
        assert (len(found), found.left_out) == (kept, len(soup) - kept)
        middles = whole.vertices[:kept].mean(axis=1, keepdims=True)
        larger = middles + enlargement(kept / len(soup)) * (whole.vertices[:kept] - middles)
        np.testing.assert_allclose(found.vertices, larger, rtol=1e-4, atol=1e-3)
    for cut in (0, 3, 11, 40, ends[0], ends[1] - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError, match=r"soup\.etz: cannot be read \(.*\); export it again"):
            read_compact(path)


def test_the_fewer_triangles_the_larger_they_are():
    """Never larger than equal ones must be to cover the same; and not at all where none is missing."""
    shares = np.linspace(0.001, 1, 100)
    factors = np.array([enlargement(share) for share in shares])
    assert (np.diff(factors) < 0).all()
    assert (factors <= shares**-0.5).all()
    assert factors[-1] == 1


def test_a_file_that_enlarges_nothing_is_read_as_it_is():
    """As they were written before."""
    data = encode_compact(soup_of(CHUNK + 10, degree=0))
    header = {name: value for name, value in header_of(data).items() if name != "enlarged"}
    text = json.dumps(header).encode()
    before = data[:8] + struct.pack("<I", len(text)) + text + data[start_of(data) :]
    assert np.array_equal(decode_compact(before[:-1]).vertices, decode_compact(data).vertices[:CHUNK])


def start_of(data):
    return 12 + struct.unpack_from("<I", data, 8)[0]


def header_of(data):
    return json.loads(data[12 : start_of(data)])


def with_header(data, **changes):
    text = json.dumps({**header_of(data), **changes}).encode()
    return data[:8] + struct.pack("<I", len(text)) + text + data[start_of(data) :]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 11}, "another number of triangles"),
        ({"count": None}, "`count` is null"),
        ({"bases": 5}, "5 bases"),
        ({"chunks": []}, "another number"),
        ({"chunks": 3}, "no chunks"),
        ({"chunks": [[10, -1]]}, "no chunks"),
        ({"chunks": [[10, True]]}, "no chunks"),
        ({"chunks": [[10**9, 10**9]], "count": 10**9}, "cannot hold"),
        ({"chunks": [[60000, 200]], "count": 60000}, "cannot hold"),
        ({"center": {"origin": [0, 0], "step": 1}}, "no origin"),
        ({"center": {"origin": [0, 0, 1e300], "step": 1}}, "no origin"),
        ({"center": {"origin": [0, 0, 0], "step": 1e200}}, "`center.step` is"),
        ({"size": {"least": 0, "per_octave": 8}}, "sizes that are none"),
        ({"size": {"least": 1, "per_octave": 0.1}}, "sizes that are none"),
        ({"sigma": {"low": 0, "step": 1}}, "softness that is none"),
        ({"sigma": {}}, r"lacks `sigma\.low`"),
        ({"notes": {"focal": 3}}, "no text"),
        ({"enlarged": 2}, "no factor"),
        ({"enlarged": [1, 1]}, "no factor"),
        ({"enlarged": [0.5]}, "no factor"),
        ({"enlarged": [1e9]}, "no factor"),
        ({"enlarged": [True]}, "no factor"),
    ],
)
def test_a_header_that_says_what_cannot_be_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        decode_compact(with_header(encode_compact(soup_of(10)), **changes))


def test_scales_may_be_whole_numbers_of_any_size():
    large = 10**20
    changes = {"center": {"origin": [large, 0, 0], "step": large}, "constant": {"step": large}, "rest": {"step": large}}
    found = decode_compact(with_header(encode_compact(soup_of(10)), **changes))
    assert found.vertices[:, 0, 0].min() == pytest.approx(large)
    assert np.isfinite(found.harmonics).all()


def test_another_version_is_named():
    data = encode_compact(soup_of(10))
    with pytest.raises(ValueError, match="of version 2, and this etsplat reads version 1"):
        decode_compact(data[:4] + struct.pack("<I", 2) + data[8:])
    with pytest.raises(ValueError, match="no compact soup"):
        decode_compact(b"PK\3\4" + data[4:])


def test_small_triangles_are_few_bytes():
    """Of degree 3 with coefficients as training leaves them: below 51 bytes, 2 MB for 39,000."""
    soup = soup_of(CHUNK)
    soup.harmonics[:, 1:] *= 0.1
    assert len(encode_compact(soup)) / CHUNK < 51


@pytest.mark.parametrize("cut", [0, 1])
def test_the_reader_of_the_description_reads_the_same(cut):
    """The one in docs/compact_format.md, of soft and of opaque triangles, whole and cut short."""
    page = (Path(__file__).parents[2] / "docs" / "compact_format.md").read_text(encoding="utf-8")
    names: dict = {}
    exec(page.split("```python\n")[1].split("```")[0], names)
    soft = soup_of(CHUNK + 20, degree=2)
    colors = np.random.default_rng(1).uniform(size=(CHUNK + 20, 3, 3)).astype(np.float32)
    for soup in (soft, CompactSoup(soft.vertices, corner_colors=colors)):
        data = encode_compact(soup)[: -cut or None]
        found = decode_compact(data)
        ours = [found.vertices, found.opacities, found.sigma, found.harmonics, found.corner_colors]
        for mine, theirs in zip([part for part in ours if part is not None], names["read"](data), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-5)
