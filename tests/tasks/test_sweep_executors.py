"""Three executors, one interface: runs that are lost in the middle end as if nothing had happened."""

import os
import pickle
import re
import socket
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from etsplat.core.errors import InputError
from etsplat.core.spelling import option, spelled_as_options
from etsplat.geometry.icosphere import icosphere
from etsplat.io.locks import writing_run
from etsplat.io.mesh_files import save_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sweeps.cells import RETRIES, Cell, run_cells
from etsplat.tasks.sweeps.executors import Executor, LostError
from etsplat.tasks.sweeps.places import Where
from etsplat.tasks.sweeps.slurm import SlurmExecutor
from etsplat.tasks.sweeps.work import perform, wait_for_writer
from tests.helpers.lost_runs import LostCell, StuckCell, digest

SHORT = ReconstructConfig.tiny().changed(
    {"iterations": 20, "output.checkpoint_every": 5, "output.chamfer_samples": 1000, "resolution": 32}
)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    vertices, faces = icosphere(2)
    path = tmp_path_factory.mktemp("meshes") / "ball.ply"
    save_mesh(path, vertices, faces)
    return path


@pytest.fixture(scope="module")
def undisturbed(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of a run that nobody touched, in a process that does what those of executors do."""
    out = tmp_path_factory.mktemp("undisturbed") / "run"
    assert perform(Cell("ball", ball, "", SHORT, out).work(1)) == ""
    return digest(out)


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes of others find the same modules."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(os.path.abspath, sys.path)))


def nothing() -> None:
    pass


class Through(Where):
    """An executor that is there already."""

    def executor(self, runs: int) -> Executor:
        return EXECUTORS[-1]


EXECUTORS: list[Executor] = []


def test_a_run_whose_process_is_killed_ends_with_the_same_bits(ball: Path, undisturbed: str, tmp_path: Path) -> None:
    """On this machine; the run beside it is none the worse."""
    cells: list[Cell] = [
        LostCell("ball", ball, "a", SHORT, tmp_path / "a"),
        Cell("ball", ball, "b", SHORT, tmp_path / "b"),
    ]
    run_cells(cells, Where(jobs=2, cores=1), nothing)
    assert [(cell.state, cell.error) for cell in cells] == [("done", "")] * 2
    assert [digest(cell.folder) for cell in cells] == [undisturbed] * 2
    assert cells[0].log.read_text().count("goes on") == 1
    assert "goes on" not in cells[1].log.read_text()


@pytest.mark.usefixtures("modules")
def test_submitit_runs_what_was_lost_again(ball: Path, undisturbed: str, tmp_path: Path) -> None:
    """By its local executor, which does with processes what Slurm does with jobs."""
    pytest.importorskip("submitit", reason="submitit is not installed (the extra slurm)")
    cells = [LostCell("ball", ball, "a", SHORT, tmp_path / "a")]
    EXECUTORS.append(SlurmExecutor(tmp_path / "jobs", 1, {"timeout_min": "5"}, cluster="local"))
    run_cells(cells, Through(), nothing)
    assert [(cell.state, cell.error) for cell in cells] == [("done", "")]
    assert digest(cells[0].folder) == undisturbed
    assert cells[0].log.read_text().count("goes on") == 1


def test_submitit_says_what_is_wrong_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No Slurm here; a parameter that there is not; no submitit."""
    pytest.importorskip("submitit", reason="submitit is not installed (the extra slurm)")
    with pytest.raises(InputError, match=r"cluster local: .*color"):
        SlurmExecutor(tmp_path, 1, {"color": "red"}, cluster="local")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="cluster slurm: "):
        Where(cluster="slurm", folder=tmp_path).executor(1)
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(InputError, match=r"needs submitit; pip install 'etsplat\[slurm\]'"):
        Where(cluster="slurm", folder=tmp_path).executor(1)


@pytest.mark.slow
@pytest.mark.usefixtures("modules")
def test_a_ray_cluster_loses_a_node(ball: Path, undisturbed: str, tmp_path: Path) -> None:
    """Two nodes on this machine. A run's process is killed, a run's node goes: both end with the same bits."""
    ray = pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        second = cluster.add_node(num_cpus=1)
        StuckCell.doomed = second.node_id
        names = ("a", "b", "c")
        kinds = (StuckCell, StuckCell, LostCell)
        cells = [kind("ball", ball, name, SHORT, tmp_path / name) for kind, name in zip(kinds, names, strict=True)]
        removed = []

        def remove() -> None:
            if not removed and list(tmp_path.glob("* waits")):
                removed.append(second)
                cluster.remove_node(second, allow_graceful=False)

        run_cells(cells, Where(cluster=cluster.address), remove)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert removed
    assert [(cell.state, cell.error) for cell in cells] == [("done", "")] * 3
    assert [digest(cell.folder) for cell in cells] == [undisturbed] * 3


def test_a_ray_cluster_that_is_not_there_is_named_at_once() -> None:
    """Ray itself would wait for many minutes."""
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(InputError, match=f"cluster 127.0.0.1:{port}: nobody answers there"):
        Where(cluster=f"127.0.0.1:{port}").executor(1)


@pytest.mark.parametrize(
    ("address", "error", "said"),
    [
        ("auto", ConnectionError("Please specify `--address`."), "auto: no Ray runs on this machine; start one"),
        ("auto", RuntimeError("Versions differ:\n 1 and 2."), "auto: Versions differ: 1 and 2; start one"),
        ("ray", ValueError("no such address"), "ray: no such address; start one with `ray start --head`, or name"),
    ],
)
def test_what_ray_says_is_told_but_for_options_that_are_not_ours(
    monkeypatch: pytest.MonkeyPatch, address: str, error: Exception, said: str
) -> None:
    def init(**_: object) -> None:
        raise error

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: False, init=init))
    with pytest.raises(InputError, match=re.escape(said)):
        Where(cluster=address).executor(1)


def test_ray_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"cluster auto: needs Ray; pip install 'etsplat\[cluster\]'"):
        Where(cluster="auto").executor(1)


class Losing(Executor):
    """Loses everything that it is given."""

    threads = 1

    def __init__(self) -> None:
        self.submitted, self.closed = 0, False

    def submit(self, work: object) -> "Losing":
        self.submitted += 1
        return Losing()

    def done(self) -> bool:
        return True

    def result(self) -> str:
        raise LostError("it is gone")

    def stop(self) -> None: ...

    def close(self) -> None:
        self.closed = True


def test_retries_come_to_an_end(ball: Path, tmp_path: Path) -> None:
    """And the cell says what became of the last attempt."""
    EXECUTORS.append(losing := Losing())
    cells = [Cell("ball", ball, "a", SHORT, tmp_path / "a")]
    run_cells(cells, Through(), nothing)
    assert (cells[0].state, cells[0].error, losing.submitted) == ("failed", "it is gone", RETRIES + 1)
    assert losing.closed


def test_what_would_fail_again_is_not_tried_again(tmp_path: Path) -> None:
    """The line names the input, and the log has it too; no traceback, since it is no error of ours."""
    cells = [Cell("gone", tmp_path / "gone.ply", "a", SHORT, tmp_path / "a")]
    run_cells(cells, Where(jobs=1), nothing)
    assert cells[0].state == "failed"
    assert "gone.ply" in cells[0].error
    log = cells[0].log.read_text()
    assert log.count("begins") == 1
    assert cells[0].error in log
    assert "Traceback" not in log


def test_a_run_waits_for_who_writes_it(ball: Path, tmp_path: Path) -> None:
    """A process that is thought dead may take a while to end."""
    with writing_run(tmp_path / "run", print), pytest.raises(InputError, match="is writing this run"):
        wait_for_writer(tmp_path / "run", patience=0)
    wait_for_writer(tmp_path / "run", patience=0)


def test_a_run_elsewhere_spells_settings_as_who_asked_for_it(ball: Path, tmp_path: Path) -> None:
    """Its process has no command line: `etsplat sweep` shows what it answers."""
    cell = Cell("ball", ball, "", SHORT, tmp_path / "run")
    RunDirectory.create(cell.folder, {"task": "reconstruct"})
    with spelled_as_options():
        asked = pickle.dumps(replace(cell.work(1), run=_refused))
    assert perform(pickle.loads(asked)) == "go on with --resume"
    assert perform(replace(cell.work(1), run=_refused)) == "go on with resume=True"


def _refused(*_: object, **given: object) -> None:
    raise InputError(f"go on with {option('resume', given['resume'])}")


def test_places_that_contradict_themselves_are_refused() -> None:
    for options, message in (
        ({"jobs": -1}, "jobs: is -1; it must be at least 1, or 0 for one on each core"),
        ({"cores": 0}, "cores: is 0; it must be at least 1"),
        ({"slurm": {"timeout_min": "1"}}, 'slurm: has an effect only with cluster="slurm"; leave'),
    ):
        with pytest.raises(InputError, match=message):
            Where(**options)  # pyright: ignore[reportArgumentType]


def test_a_finished_run_is_known_by_its_settings(ball: Path, tmp_path: Path) -> None:
    cell = Cell("ball", ball, "a", SHORT, tmp_path / "a")
    reconstruct(ball, cell.folder, SHORT)
    cell.look()
    assert (cell.state, cell.progress()) == ("done", 1.0)
    assert cell.metrics() == RunDirectory(cell.folder).read_metrics()
    other = Cell("ball", ball, "a", SHORT.changed({"seed": 1}), cell.folder)
    other.look()
    assert (other.state, other.seed) == ("waiting", 1)
