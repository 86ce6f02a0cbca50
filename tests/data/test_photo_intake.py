"""Folders of photos, as their owners have them, before COLMAP sees them."""

import pytest
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.photo_intake import by_camera, list_photos, take_in, unread_pictures
from helpers.photos import upright_picture, write_phone_photo


@pytest.fixture
def mixed(tmp_path):
    """Two phones with EXIF, one of them in both folders; a camera without in each folder; one photo on its side."""
    folder = tmp_path / "photos"
    for name, size, tags in [
        ("one/a.jpg", (40, 24), {"model": "X", "focal_mm": 4.0}),
        ("one/b.jpg", (40, 24), {"model": "X", "focal_mm": 8.0}),
        ("one/c.jpg", (40, 24), {}),
        ("two/a.jpg", (40, 24), {"model": "X", "focal_mm": 4.0}),
        ("two/c.jpg", (40, 24), {}),
        ("two/d.jpg", (30, 24), {}),
    ]:
        write_phone_photo(folder / name, upright_picture(*size), **tags)
    write_phone_photo(folder / "two" / "e.jpg", upright_picture(24, 40), 6)
    return folder


def test_photos_of_one_camera_are_told_by_what_they_say_or_by_folder_and_size(mixed):
    photos = list_photos(mixed)
    assert by_camera(photos, "auto") == [
        ["one/a.jpg", "two/a.jpg"],
        ["one/b.jpg"],
        ["one/c.jpg"],
        ["two/c.jpg"],
        ["two/d.jpg"],
        ["two/e.jpg"],
    ]
    assert by_camera(photos, "folder") == [
        ["one/a.jpg", "one/b.jpg", "one/c.jpg"],
        ["two/a.jpg", "two/c.jpg"],
        ["two/d.jpg"],
        ["two/e.jpg"],
    ]
    assert len(by_camera(photos, "photo")) == 7


def test_upright_photos_are_linked_and_others_turned_under_their_names(mixed, tmp_path):
    photos, told = list_photos(mixed), []
    take_in(photos, tmp_path / "work", 1, lambda *state: told.append(state))
    for photo in photos:
        with Image.open(tmp_path / "work" / photo.name) as image:
            assert image.size == photo.file.size
    assert (tmp_path / "work" / "one" / "a.jpg").samefile(mixed / "one" / "a.jpg")
    assert not (tmp_path / "work" / "two" / "e.jpg").samefile(mixed / "two" / "e.jpg")
    assert told[-1] == ("Reading photos", 7, 7)


def test_photos_cut_short_are_refused(mixed, tmp_path):
    """Their headers are whole, and COLMAP takes what is there."""
    path = mixed / "two" / "c.jpg"
    path.write_bytes(path.read_bytes()[:-100])
    photos = list_photos(mixed)
    with pytest.raises(InputError, match=r"two/c\.jpg: damaged or cut short .*; copy it again"):
        take_in(photos, tmp_path / "work", 1, lambda *state: None)


def test_what_is_hidden_is_no_photo_and_two_of_one_name_are_refused(mixed):
    """macOS leaves ._a.jpg beside a.jpg; phones export a.heic beside a.jpg."""
    pytest.importorskip("pillow_heif")
    (mixed / "one" / "._a.jpg").write_bytes(b"no picture")
    (mixed / ".thumbnails").mkdir()
    (mixed / ".thumbnails" / "a.jpg").write_bytes(b"no picture")
    assert len(list_photos(mixed)) == 7
    write_phone_photo(mixed / "one" / "a.heic", upright_picture())
    with pytest.raises(InputError, match=r"a\.heic and a\.jpg would both be one/a\.jpg; keep one"):
        list_photos(mixed)


def test_pictures_of_kinds_that_are_not_read_are_counted_where_photos_lack(tmp_path):
    for name in ("a.webp", "b.webp", "c.TIF"):
        (tmp_path / name).write_bytes(b"a picture")
    with pytest.raises(InputError, match=r"0 JPEG, PNG or HEIC files, and 3 pictures of kinds that are not read: conv"):
        list_photos(tmp_path)


def test_pictures_that_are_not_read_are_named_unless_a_photo_of_that_name_is_there(tmp_path):
    """Raw files lie beside the photos that cameras made of them; of others nobody said that they were left out."""
    (tmp_path / "day").mkdir()
    for name in ("a.JPG", "a.NEF", "day/b.webp", ".trash.webp", "c.txt"):
        (tmp_path / name).touch()
    assert unread_pictures(tmp_path) == ["day/b.webp"]
