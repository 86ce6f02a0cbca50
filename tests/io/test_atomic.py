import os
import subprocess
import sys

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.io.atomic import atomic_write
from etsplat.io.images import save_image
from etsplat.io.mesh_files import save_mesh

resource = pytest.importorskip("resource")


def test_the_file_appears_with_the_written_content(tmp_path):
    with atomic_write(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_failing_writer_leaves_the_old_file_and_nothing_else(tmp_path):
    (tmp_path / "a.txt").write_text("old")

    def write():
        with atomic_write(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise RuntimeError("the writer failed")

    with pytest.raises(RuntimeError, match="the writer failed"):
        write()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_missing_folder_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match=r"absent.*create the folder"), atomic_write(tmp_path / "absent" / "a") as file:
        file.write_text("x")


def test_a_file_in_the_place_of_a_folder_is_an_input_error_that_names_what_was_asked_for(tmp_path):
    """Of an earlier version it speaks where there is one."""
    (tmp_path / "a").write_text("old")
    with pytest.raises(InputError, match=r"cannot write .*/a/b\.txt: Not a directory; .*choose another folder$"):  # noqa: SIM117
        with atomic_write(tmp_path / "a" / "b.txt") as file:
            file.write_text("x")
    with pytest.raises(InputError, match="an earlier version of the file is unchanged"), atomic_write(tmp_path / "a"):
        raise OSError(28, "No space left on device")


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_read_only_folder_is_an_input_error(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="may write"), atomic_write(tmp_path / "a") as file:
        file.write_text("x")


def test_a_write_beyond_the_file_size_limit_keeps_the_old_file(tmp_path):
    """A limit on the file size makes the operating system refuse the write, as a full disk does."""
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(InputError) as raised, atomic_write(path) as temporary:
            temporary.write_bytes(bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(raised.value)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.ply", "a.obj", "a.glb"])
def test_every_writer_keeps_the_old_file_when_the_disk_refuses_the_new_one(tmp_path, name, rng):
    """Images and meshes larger than the limit on the file size."""
    (tmp_path / name).write_bytes(b"old")
    image, ball = torch.rand(64, 64, 3, generator=rng), icosphere(3)

    def write():
        if name in ("a.png", "a.jpg"):
            save_image(tmp_path / name, image)
        else:
            save_mesh(tmp_path / name, *ball)

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(InputError) as raised:
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(tmp_path / name) in str(raised.value)
    assert "\n" not in str(raised.value)
    assert (tmp_path / name).read_bytes() == b"old"
    assert os.listdir(tmp_path) == [name]


def test_a_killed_writer_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    code = (
        "import os, sys\nfrom etsplat.io.atomic import atomic_write\n"
        "with atomic_write(sys.argv[1]) as t:\n    t.write_text('half')\n    os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code, str(path)]).returncode != 0
    assert path.read_text() == "old"
