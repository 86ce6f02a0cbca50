from pathlib import Path

import pytest

from etsplat.core.errors import InputError
from etsplat.io.paths import path_remedy, path_within


@pytest.mark.parametrize("name", ["a.jpg", "left/0001.jpg", "./a.jpg", "..a/b..jpg", "a..b/c"])
def test_a_name_in_the_folder_is_joined(name):
    assert path_within(Path("photos"), name, "cameras.bin") == Path("photos") / name


@pytest.mark.parametrize(
    "name",
    ["../a.jpg", "x/../../a.jpg", "x/..", "..", "/etc/passwd", "//host/a", "..\\a.jpg", "x\\..\\..\\a", "C:\\a.jpg",
     "C:a.jpg", "\\a.jpg", "\\\\host\\share\\a.jpg"],
)  # fmt: skip
def test_a_name_that_leads_out_is_refused_on_every_system(name):
    with pytest.raises(InputError) as caught:
        path_within(Path("photos"), name, "cameras.bin")
    told = f"cameras.bin: {name!r} leads out of photos; copy the file there and name it in that folder"
    assert str(caught.value) == told


@pytest.mark.parametrize(
    "name", ["", ".", "./", "a\0.jpg", "a\nb.jpg", "a" * 300 + ".jpg", "x/" + "é" * 130, "a/" * 2000, "\ud800.jpg"]
)
def test_what_is_no_file_name_is_refused(name):
    with pytest.raises(InputError, match=r"cameras\.bin: .* is no file name"):
        path_within(Path("photos"), name, "cameras.bin")


def test_what_a_killed_command_left_is_no_suggestion(tmp_path: Path) -> None:
    """Scratch folders are named like what they were to become; a hidden one is suggested to who typed a dot."""
    (tmp_path / ".brighton-798cbx0v").mkdir()
    assert path_remedy(tmp_path / "brighton") == "check the path"
    assert path_remedy(tmp_path / ".brighton-798cbx0") == f"did you mean {tmp_path / '.brighton-798cbx0v'}?"
