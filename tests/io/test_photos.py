"""Photos as phones write them come out upright, with their EXIF."""

import builtins

import numpy as np
import pytest
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.io.photos import inspect_photo, write_upright
from helpers.photos import upright_picture, write_phone_photo

KINDS = ["jpg", "png", "heic"]


def skip_without_decoder(kind: str) -> None:
    if kind == "heic":
        pytest.importorskip("pillow_heif")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_photo_is_upright_whatever_way_it_was_stored(tmp_path, kind, orientation):
    """Its size is known without decoding it; the copy shows every corner where it belongs and has the focal length."""
    skip_without_decoder(kind)
    path, copy = tmp_path / f"a.{kind}", tmp_path / "b.jpg"
    write_phone_photo(path, upright_picture(), orientation, model="Phone 7", focal_mm=4.25)
    known = inspect_photo(path)
    assert known.size == (40, 24)
    assert known.upright == (orientation == 1 and kind != "heic")
    write_upright(path, copy)
    with Image.open(copy) as image:
        difference = np.abs(np.asarray(image, dtype=int) - np.asarray(upright_picture(), dtype=int))
    assert difference.max() < 24
    assert difference.mean() < 4
    assert inspect_photo(copy).upright
    assert inspect_photo(copy).taken_with == known.taken_with
    assert known.taken_with.focal_mm == 4.25


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_photos_are_one_line(tmp_path, kind):
    """Cut short anywhere, empty, or something else."""
    skip_without_decoder(kind)
    path = tmp_path / f"a.{kind}"
    write_phone_photo(path, upright_picture())
    whole = path.read_bytes()
    for data in (b"", b"no picture at all", whole[:20], whole[: len(whole) // 2], whole[: -len(whole) // 3]):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"image .*a\.") as raised:
            write_upright(path, tmp_path / "b.jpg")
        assert "\n" not in str(raised.value)
    assert not (tmp_path / "b.jpg").exists()


def test_heic_without_its_decoder_names_the_extra(tmp_path, monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "pillow_heif":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    (tmp_path / "a.HEIC").write_bytes(b"anything")
    with pytest.raises(InputError, match=r"etsplat\[heic\]"):
        inspect_photo(tmp_path / "a.HEIC")
