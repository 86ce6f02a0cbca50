"""Runs kept where fsspec reaches: in memory, and in a bucket that moto plays."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import save_mesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sweeps.cells import Cell, run_cells
from etsplat.tasks.sweeps.places import Where
from etsplat.tasks.sweeps.store import Store, open_store
from etsplat.tasks.sweeps.work import perform
from tests.helpers.lost_runs import LostCell, digest

SHORT = ReconstructConfig.tiny().changed(
    {"iterations": 20, "output.checkpoint_every": 5, "output.chamfer_samples": 1000, "resolution": 32}
)


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    vertices, faces = icosphere(2)
    save_mesh(tmp_path / "ball.ply", vertices, faces)
    return tmp_path / "ball.ply"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """One of S3, played by this process."""
    pytest.importorskip("s3fs", reason="s3fs is not installed (the extra s3)")
    server = pytest.importorskip("moto.server", reason="moto is not installed").ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    monkeypatch.setenv("AWS_ENDPOINT_URL_S3", f"http://{host}:{port}")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    try:
        files, _ = open_store("s3://runs")
        files.mkdir("runs")
        yield "s3://runs/sweep"
    finally:
        server.stop()


def test_a_run_goes_on_from_a_bucket_on_a_machine_that_has_nothing(ball: Path, bucket: str, tmp_path: Path) -> None:
    """It is killed after its first checkpoint, and its folder is gone; it ends with the bits of an undisturbed run."""
    perform(Cell("ball", ball, "a", SHORT, tmp_path / "undisturbed").work(1))
    cell = LostCell("ball", ball, "a", SHORT, tmp_path / "here" / "run", store=f"{bucket}/run")
    run_cells([cell], Where(jobs=1, cores=1), lambda: None)
    assert (cell.state, cell.error) == ("done", "")
    assert digest(cell.folder) == digest(tmp_path / "undisturbed")
    assert cell.log.read_text().count("goes on") == 1
    elsewhere = Cell("ball", ball, "a", SHORT, tmp_path / "there", store=f"{bucket}/run")
    elsewhere.look()  # as who started the sweep does, on another machine
    assert elsewhere.state == "done"
    assert elsewhere.metrics() == cell.metrics()
    assert not (tmp_path / "there" / "checkpoints").exists()


def test_a_folder_is_kept_as_it_is(tmp_path: Path) -> None:
    """What has changed is copied, what has gone is removed, locks stay; nothing of an unfinished run is a result."""
    store = Store(f"memory://{tmp_path.name}/kept", tmp_path / "a")
    (tmp_path / "a" / "checkpoints").mkdir(parents=True)
    for name in ("checkpoints/1", "config.json", ".lock"):
        (tmp_path / "a" / name).write_text("old")
    store.keep()
    (tmp_path / "a" / "checkpoints" / "1").rename(tmp_path / "a" / "checkpoints" / "2")
    (tmp_path / "a" / "config.json").write_text("newer")
    store.keep()
    copy = Store(store.url, tmp_path / "b")
    copy.fetch(results_only=True)
    assert not (tmp_path / "b").exists()
    copy.fetch()
    found = {path.relative_to(tmp_path / "b").as_posix(): path.read_text() for path in (tmp_path / "b").rglob("*.*")}
    assert found == {"config.json": "newer"}
    assert [path.name for path in (tmp_path / "b" / "checkpoints").iterdir()] == ["2"]


def test_places_that_cannot_be_reached_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"store nowhere://a: .*write it as fsspec does"):
        Store("nowhere://a", tmp_path)
    monkeypatch.delitem(
        vars(sys.modules["fsspec.registry"])["_registry"], "s3", raising=False
    )  # where an earlier test has used it
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(InputError, match=r"store s3://a: needs a package .*pip install 'etsplat\[s3\]'"):
        Store("s3://a", tmp_path)
    (tmp_path / "x").mkdir()
    for name in ("file", "x/config.json"):
        (tmp_path / name).touch()
    store = Store(f"file://{tmp_path}/file/run", tmp_path / "x")
    with pytest.raises(InputError, match="store file://"):
        store.keep()
