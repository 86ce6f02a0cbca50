import contextlib
import gc
import io
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import torch
from PIL import EpsImagePlugin, Image

from etsplat.core.errors import InputError
from etsplat.io.images import (
    image_size,
    load_image,
    load_mask,
    load_mask_pixels,
    load_pixels,
    over_background,
    premultiply,
    resize_image,
    save_image,
    size_for,
)
from helpers.photos import upright_picture, write_phone_photo


@pytest.fixture
def picture():
    return torch.randint(0, 256, (7, 5, 4), generator=torch.Generator().manual_seed(3)).float() / 255


@pytest.mark.parametrize("channels", [3, 4])
def test_png_keeps_8_bit_values_exactly(tmp_path, picture, channels):
    save_image(tmp_path / "a.png", picture[..., :channels])
    assert torch.equal(load_image(tmp_path / "a.png"), picture[..., :channels])
    assert image_size(tmp_path / "a.png") == (5, 7)


def test_jpeg_keeps_a_smooth_image_within_two_steps(tmp_path):
    ramp = torch.linspace(0, 1, 64)[None, :, None].expand(64, 64, 3)
    save_image(tmp_path / "a.jpg", ramp)
    assert (load_image(tmp_path / "a.jpg") - ramp).abs().max() < 2.5 / 255


def test_values_outside_the_unit_interval_are_clamped(tmp_path):
    save_image(tmp_path / "a.png", torch.tensor([[[-1.0, 0.5, 3.0]]]))
    assert torch.equal(load_image(tmp_path / "a.png"), torch.tensor([[[0.0, 128 / 255, 1.0]]]))


def test_non_finite_pixels_are_refused_and_the_old_file_stays(tmp_path, picture):
    save_image(tmp_path / "a.png", picture)
    with pytest.raises(ValueError, match="finite"):
        save_image(tmp_path / "a.png", torch.full((2, 2, 3), torch.nan))
    assert torch.equal(load_image(tmp_path / "a.png"), picture)


@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 2), (1, 4, 4, 3)])
def test_wrong_shapes_name_the_argument(tmp_path, shape):
    with pytest.raises(ValueError, match="image: expected shape"):
        save_image(tmp_path / "a.png", torch.zeros(shape))


def test_pixels_of_8_bits_are_refused(tmp_path):
    """As values in [0, 1] they would be white."""
    with pytest.raises(ValueError, match=r"image must be of floating-point numbers, got torch\.uint8"):
        save_image(tmp_path / "a.png", torch.full((4, 4, 3), 200, dtype=torch.uint8))


def test_grey_palette_and_16_bit_files_become_rgb(tmp_path):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    Image.fromarray(grey).save(tmp_path / "grey.png")
    Image.fromarray(grey).convert("P").save(tmp_path / "palette.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    expected = torch.from_numpy(grey).float()[..., None].expand(3, 4, 3) / 255
    for name in ("grey", "palette", "deep"):
        torch.testing.assert_close(load_image(tmp_path / f"{name}.png"), expected)


def test_mask_is_alpha_where_it_varies_and_grey_otherwise(tmp_path, picture):
    save_image(tmp_path / "rgba.png", picture)
    assert torch.equal(load_mask(tmp_path / "rgba.png"), picture[..., 3])
    save_image(tmp_path / "grey.png", picture[..., :1])
    torch.testing.assert_close(load_mask(tmp_path / "grey.png"), picture[..., 0])


@pytest.mark.parametrize(
    ("content", "message"), [(None, "no such file"), (b"", "empty"), (b"not a picture", "not an image")]
)
def test_missing_empty_and_foreign_files_are_input_errors(tmp_path, content, message):
    path = tmp_path / "a.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_image(path)


@pytest.mark.parametrize("kind", ["TIFF", "GIF", "BMP", "TGA", "JPEG2000", "PPM", "ICO", "PCX", "SGI"])
def test_no_other_kind_of_image_is_read_whatever_its_name(tmp_path, kind):
    buffer = io.BytesIO()
    try:
        Image.fromarray(np.full((24, 32, 3), 90, np.uint8)).save(buffer, kind)
    except OSError as error:
        pytest.skip(f"Pillow was built without it: {error}")
    (tmp_path / "0001.jpg").write_bytes(buffer.getvalue())
    for read in (load_image, load_mask, image_size, lambda path: load_pixels(path, 32, 24)):
        with pytest.raises(InputError, match=r"0001\.jpg: not an image that can be read"):
            read(tmp_path / "0001.jpg")


def test_postscript_starts_no_program(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *arguments, **_: started.append(arguments))
    (tmp_path / "0001.jpg").write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 24\n%%EndComments\nshowpage\n%%EOF\n"
    )
    with pytest.raises(InputError, match="not an image"):
        load_image(tmp_path / "0001.jpg")
    assert started == []


@pytest.mark.parametrize(("width", "height"), [(40_000, 40_000), (13_000, 13_000), (9000, 9000), (2**31 - 1, 1)])
def test_an_image_of_too_many_pixels_is_refused_before_it_is_decoded(tmp_path, width, height):
    """Its file is small: 1.6e9 pixels of one bit unpack to 6 GB of floats."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    rows = chunk(b"IDAT", zlib.compress(bytes(1 << 20)))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + rows + chunk(b"IEND", b""))
    with pytest.raises(InputError, match=r"a\.png: .*(pixels|too small for)"):
        load_image(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_file_cut_short_is_an_input_error(tmp_path, suffix):
    noise = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    path = tmp_path / f"a{suffix}"
    save_image(path, noise)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="cut short"):
        load_image(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_whatever_is_in_a_damaged_file_it_is_an_image_or_an_input_error(tmp_path, picture, suffix):
    """Bytes changed, taken out and repeated, mostly near the beginning."""
    path, rng = tmp_path / f"a{suffix}", np.random.default_rng(0)
    save_image(path, picture[..., :3])
    whole, read, messages = path.read_bytes(), 0, []
    for _ in range(400):
        data, at = bytearray(whole), int(rng.integers(min(len(whole), rng.choice([60, 10**9]))))
        length = int(rng.choice([1, 2, 4, 16]))
        data[at : at + length] = rng.choice([rng.bytes(length), b"", whole[at : at + 2 * length], b"\xff" * length])
        path.write_bytes(data)
        try:
            for load in (load_image, load_mask, lambda path: load_pixels(path, 3, 4).float() / 255):
                values = load(path)
                assert 0 <= float(values.min()) <= float(values.max()) <= 1
            read += 1
        except InputError as error:
            messages.append(str(error))
    assert read > 20
    assert messages
    assert not any("\n" in message for message in messages)


def test_premultiplied_over_background_equals_the_straight_blend(picture):
    background = torch.tensor([0.2, 0.5, 0.9])
    expected = picture[..., :3] * picture[..., 3:] + background * (1 - picture[..., 3:])
    torch.testing.assert_close(over_background(premultiply(picture), background), expected)
    assert torch.equal(premultiply(picture[..., :3])[..., 3], torch.ones(7, 5))


def test_shrinking_keeps_constants_and_the_mean():
    image = torch.rand(64, 48, 4, generator=torch.Generator().manual_seed(0))
    small = resize_image(image, 12, 16)
    assert small.shape == (16, 12, 4)
    torch.testing.assert_close(small.mean(), image.mean(), atol=5e-3, rtol=0)
    torch.testing.assert_close(resize_image(torch.full((9, 9, 3), 0.3), 4, 5), torch.full((5, 4, 3), 0.3))


def test_the_length_that_a_part_of_a_png_claims_is_not_allocated(tmp_path):
    """Pillow reads what its decoder leaves of the pixels in one piece, here of 4 GB in a file of a hundred bytes."""
    whole = io.BytesIO()
    Image.new("L", (16, 12)).save(whole, "PNG")
    data = bytearray(whole.getvalue())
    data[data.index(b"IDAT") - 4] = 0xFF
    path = tmp_path / "a.png"
    path.write_bytes(data)
    tracemalloc.start()
    with contextlib.suppress(InputError):
        load_image(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_an_image_is_turned_where_only_then_it_has_the_shape_of_its_camera(tmp_path, orientation):
    """Poses mean stored pixels where COLMAP found them, turned ones where others did; the camera's shape says which."""
    upright = upright_picture()
    write_phone_photo(tmp_path / "a.png", upright, orientation)
    stored = np.asarray(Image.open(tmp_path / "a.png"))
    expected = np.asarray(upright) if orientation in (6, 8) else stored
    assert size_for(tmp_path / "a.png", (400, 240)) == (40, 24)
    assert np.array_equal(load_pixels(tmp_path / "a.png", 40, 24).numpy(), expected)
    turned = load_image(tmp_path / "a.png", (400, 240))
    assert np.array_equal((turned * 255).round().byte().numpy(), expected)
    as_stored = stored.shape[1::-1]
    assert size_for(tmp_path / "a.png", as_stored) == as_stored
    assert np.array_equal(load_pixels(tmp_path / "a.png", *as_stored).numpy(), stored)


@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 1), (np.uint16, 1), (np.uint16, 255)])
def test_a_mask_with_another_white_than_its_format_is_refused(tmp_path, kind, white):
    """It would count as nearly all black. One that is black all over is a mask of nothing."""
    inside = np.eye(12, 16)
    Image.fromarray((inside * white).astype(kind)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: is nearly black all over.*write 255 inside masks that have 1 there"):
        load_mask_pixels(tmp_path / "a.png", 16, 12)
    Image.fromarray((inside * 0).astype(kind)).save(tmp_path / "a.png")
    assert not load_mask(tmp_path / "a.png").any()


def test_a_picture_with_channels_first_is_named(tmp_path):
    with pytest.raises(
        ValueError, match=r"image: expected shape \(H, W, C\), got \(3, 8, 8\): pass image\.permute\(1, 2, 0\)"
    ):
        save_image(tmp_path / "x.png", torch.rand(3, 8, 8))
    assert not (tmp_path / "x.png").exists()


def test_an_image_that_may_not_be_read_is_one_line(tmp_path, monkeypatch, capfd):
    """Nor is anything written where the file, which was never opened, is let go of."""
    save_image(tmp_path / "a.png", torch.zeros(4, 4, 3))

    def refuse(path):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr("etsplat.io.images.io.FileIO", refuse)
    with pytest.raises(
        InputError, match=r"image .*a\.png: cannot be read \(Permission denied\); check its permissions"
    ):
        load_image(tmp_path / "a.png")
    gc.collect()
    assert capfd.readouterr().err == ""
