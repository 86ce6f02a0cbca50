"""What is fetched is what was meant, or nothing of it stays."""

import os
import zipfile

import pytest

from etsplat.core.errors import InputError
from etsplat.io import datasets
from etsplat.io.datasets import Dataset, download_dataset

SCENE = ("truck/images/1.jpg", "truck/sparse/0/cameras.txt", "licence.txt")


@pytest.fixture
def serve(tmp_path, monkeypatch):
    """Puts an archive of these names where that of data set "tiny" comes from."""

    def put(*names, scenes=("truck",), gigabytes=0.001, content=b""):
        path = tmp_path / "archive.zip"
        with zipfile.ZipFile(path, "w") as file:
            for name in names:
                file.writestr(name, content or name)
        monkeypatch.setitem(datasets.DATASETS, "tiny", Dataset(path.as_uri(), scenes, gigabytes))
        return tmp_path / "data"

    return put


@pytest.mark.parametrize(
    "names",
    [
        ["train/sparse/0/cameras.txt"],
        [*SCENE, "extra/../../evil.txt"],
        [*SCENE, "/evil.txt"],
        [*SCENE, "C:/evil.txt"],
    ],
)
def test_another_archive_is_refused_and_nothing_of_it_stays(serve, names, tmp_path):
    out = serve(*names)
    with pytest.raises(InputError, match=r"without truck|leads out of"):
        download_dataset("tiny", out)
    assert list(out.iterdir()) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["archive.zip", "data"]


def test_an_archive_of_another_size_is_refused_before_it_fills_the_disk(serve):
    out = serve(*SCENE, gigabytes=1e-6, content=os.urandom(10000))
    with pytest.raises(InputError, match="larger than"):
        download_dataset("tiny", out)
    assert list(out.iterdir()) == []


def test_nobody_can_know_the_name_under_which_the_archive_is_written(serve, tmp_path):
    """A link of that name would be written through."""
    out = serve(*SCENE)
    out.mkdir()
    (tmp_path / "precious").write_text("mine")
    (out / ".tiny.zip").symlink_to(tmp_path / "precious")
    download_dataset("tiny", out)
    assert (tmp_path / "precious").read_text() == "mine"


def test_what_is_there_already_is_completed_and_the_rest_left_alone(serve):
    """As after a download that was killed; a scene without its sparse/ is not there yet."""
    out = serve(*SCENE)
    (out / "truck" / "images").mkdir(parents=True)
    (out / "truck" / "images" / "1.jpg").write_text("half")
    (out / "truck" / "notes.txt").write_text("mine")
    download_dataset("tiny", out)
    for name in SCENE:
        assert (out / name).read_text() == name
    assert (out / "truck" / "notes.txt").read_text() == "mine"
    assert sorted(path.name for path in out.iterdir()) == ["licence.txt", "truck"]


@pytest.fixture
def archive(tmp_path, monkeypatch):
    path = tmp_path / "archive.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("truck/sparse/0/cameras.txt", "")
    monkeypatch.setitem(datasets.DATASETS, "tiny", Dataset(path.as_uri(), ("truck",), 0.001))
    return path


def test_a_data_set_is_fetched_once(tmp_path, archive):
    done = []
    assert download_dataset("tiny", tmp_path / "data", progress=lambda *state: done.append(state)) == [
        tmp_path / "data" / "truck"
    ]
    assert done[-1] == (archive.stat().st_size, archive.stat().st_size)
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["truck"]
    archive.unlink()
    download_dataset("tiny", tmp_path / "data")


def test_without_a_network_the_address_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(datasets.DATASETS, "tiny", Dataset("http://127.0.0.1:9/a.zip", ("truck",), 0.001))
    with pytest.raises(InputError, match=r"cannot reach http://127\.0\.0\.1:9/a\.zip.*unpack it into"):
        download_dataset("tiny", tmp_path / "data")
    (tmp_path / "no.zip").write_text("not a zip")
    monkeypatch.setitem(datasets.DATASETS, "tiny", Dataset((tmp_path / "no.zip").as_uri(), ("truck",), 0.001))
    with pytest.raises(InputError, match="damaged"):
        download_dataset("tiny", tmp_path / "data")
