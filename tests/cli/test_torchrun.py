"""Runs that torchrun's workers make together: the files of one process, and what is left when a worker is killed."""

import hashlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from etsplat.optim.checkpoints import list_checkpoints
from helpers.commands import Run
from helpers.shared_runs import digest_of_checkpoint

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds the workers in /proc"),
]

SCENE = ("demo", "scene", "--preset", "tiny", "--batch", "3", "--iterations", "24", "--asset")
OBJECT = ("demo", "object", "--preset", "tiny", "--batch", "3", "--iterations", "60")
PATIENCE = 60.0


ONE_MACHINE = ("--standalone", "--nproc-per-node", "2")


def torchrun(
    folder: Path, *arguments: str, restarts: int = 0, places: Sequence[str] = ONE_MACHINE
) -> "subprocess.Popen[str]":
    launcher = [sys.executable, "-m", "torch.distributed.run", *places]
    launcher += ["--max-restarts", str(restarts), "-m", "etsplat"]
    threads = {"OMP_NUM_THREADS": "1", "ETSPLAT_NUM_THREADS": "1"}
    environment = {**os.environ, **threads, "PYTHONPATH": os.pathsep.join(sys.path)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*launcher, *arguments], cwd=folder, env=environment, **pipes)


@pytest.mark.parametrize(("options", "results"), [(SCENE, ["soup", "opaque"]), (OBJECT, ["mesh"])])
def test_two_workers_write_the_files_of_one(
    etsplat: Run, tmp_path: Path, options: tuple[str, ...], results: list[str]
) -> None:
    """Soup and mesh, the opaque mesh too, whose stages are trained as well; and only one of them prints."""
    launched = torchrun(tmp_path, *options, "--out", "two")
    assert etsplat(*options, "--out", "one", cwd=tmp_path).returncode == 0
    output, errors = launched.communicate(timeout=600)
    assert launched.returncode == 0, errors
    assert output.count("Measuring the result") == 1
    one, two = tmp_path / "one", tmp_path / "two"
    assert digest_of_checkpoint(one) == digest_of_checkpoint(two)
    names = {path.name for path in one.iterdir() if path.is_file()}
    assert names == {path.name for path in two.iterdir() if path.is_file()}
    compared = [name for name in sorted(names) if name.split(".")[0] in results]
    assert compared
    for name in compared:
        assert digest_of(one / name) == digest_of(two / name), name


def test_machines_meet_by_the_rendezvous_of_torchrun(etsplat: Run, tmp_path: Path) -> None:
    """Two launchers, as of two machines, each with a worker and a folder of its own: that of the first has the run."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    places = ["--nnodes", "2", "--nproc-per-node", "1", "--rdzv-backend", "c10d"]
    places += ["--rdzv-id", "run", "--rdzv-endpoint", f"127.0.0.1:{port}"]
    folders = [tmp_path / "first", tmp_path / "second"]
    for folder in folders:
        folder.mkdir()
    launched = [torchrun(folder, *OBJECT, "--out", "run", places=places) for folder in folders]
    assert etsplat(*OBJECT, "--out", "whole", cwd=tmp_path).returncode == 0
    for each in launched:
        _, errors = each.communicate(timeout=600)
        assert each.returncode == 0, errors
    runs = [folder / "run" for folder in folders if (folder / "run").exists()]
    assert len(runs) == 1
    assert digest_of_checkpoint(runs[0]) == digest_of_checkpoint(tmp_path / "whole")
    assert digest_of(runs[0] / "mesh.ply") == digest_of(tmp_path / "whole" / "mesh.ply")


@pytest.mark.parametrize("killed", [0, 1])
def test_a_killed_worker_ends_the_run_which_goes_on_later(etsplat: Run, tmp_path: Path, killed: int) -> None:
    """Whichever it is: within a minute, with one line; one process ends the run with the bits of an undisturbed one."""
    options = [*OBJECT[:-1], "400", "--output.checkpoint-every", "10", "--out"]
    launched = torchrun(tmp_path, *options, "run")
    kill_one(launched, tmp_path / "run", killed)
    _, errors = launched.communicate(timeout=PATIENCE)
    assert launched.returncode != 0
    said = [line for line in errors.splitlines() if line.startswith("etsplat: ")]
    assert len(said) == 1, errors
    assert "--resume" in said[0]
    assert "etsplat/core/workers.py" not in errors  # torchrun has a traceback of its own, we have none
    assert list_checkpoints(tmp_path / "run" / "checkpoints")[-1].stem < "step_000400"
    assert etsplat(*options, "run", "--resume", cwd=tmp_path).returncode == 0
    assert etsplat(*options, "whole", cwd=tmp_path).returncode == 0
    assert digest_of_checkpoint(tmp_path / "run") == digest_of_checkpoint(tmp_path / "whole")


def test_torchrun_starts_killed_workers_again(etsplat: Run, tmp_path: Path) -> None:
    """They go on from the last checkpoint, though nobody said --resume."""
    options = [*OBJECT[:-1], "120", "--output.checkpoint-every", "10", "--out"]
    launched = torchrun(tmp_path, *options, "run", restarts=1)
    kill_one(launched, tmp_path / "run", 1)
    _, errors = launched.communicate(timeout=180)
    assert launched.returncode == 0, errors
    assert etsplat(*options, "whole", cwd=tmp_path).returncode == 0
    assert digest_of_checkpoint(tmp_path / "run") == digest_of_checkpoint(tmp_path / "whole")


def kill_one(launched: "subprocess.Popen[str]", run: Path, rank: int) -> None:
    """When the run has two checkpoints."""
    waiting = time.monotonic()
    while len(list_checkpoints(run / "checkpoints")) < 2:
        assert launched.poll() is None, launched.communicate()
        assert time.monotonic() - waiting < 300
        time.sleep(0.05)
    os.kill(workers_of(launched.pid)[rank], signal.SIGKILL)


def workers_of(launcher: int) -> list[int]:
    """Processes that torchrun started, in the order of their ranks."""
    children = [int(child) for child in Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split()]

    def rank(child: int) -> int:
        entries = Path(f"/proc/{child}/environ").read_bytes().split(b"\0")
        return next((int(entry[5:]) for entry in entries if entry.startswith(b"RANK=")), -1)

    return sorted((child for child in children if rank(child) >= 0), key=rank)


def digest_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
