"""Runs from the command line: errors in one line, interruptions, and what is left."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from etsplat.cli.command import Command, resume_line
from etsplat.cli.doctor import Doctor
from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from tests.helpers.commands import PROGRAM, Run, assert_one_line_error, in_own_process
from tests.helpers.torch_threads import COUNTS, on_each_count


def test_memory_that_torch_does_not_get_is_no_traceback(etsplat: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its allocator raises a RuntimeError; others stay what they are."""

    def fail(command: Command, arguments: Sequence[str]) -> int:
        raise RuntimeError(message)

    monkeypatch.setattr(Doctor, "run", fail)
    message = "[enforce fail at alloc_cpu.cpp:119] err == 0. DefaultCPUAllocator: can't allocate memory"
    result = etsplat("doctor")
    assert result.returncode == 1
    assert "not enough memory" in result.stderr
    message = "something else"
    with pytest.raises(RuntimeError, match="something else"):
        parse(["doctor"]).run(["doctor"])


def test_missing_mesh(etsplat: Run, tmp_path: Path) -> None:
    """A missing input is named, nothing is written."""
    result = etsplat("reconstruct", "no.ply", "--out", "run", cwd=tmp_path)
    assert_one_line_error(result, "no.ply", "no such file")
    assert list(tmp_path.iterdir()) == []


def test_truncated_mesh(etsplat: Run, sphere: Path) -> None:
    """A mesh file that was cut short is refused."""
    sphere.write_bytes(sphere.read_bytes()[:3000])
    assert_one_line_error(etsplat("reconstruct", str(sphere), "--out", "run", cwd=sphere.parent), "sphere.ply")


def test_repairs_of_the_input_are_told(etsplat: Run, tmp_path: Path) -> None:
    """Polygons that were cut into triangles are mentioned, and the run goes on."""
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    quads = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {quad}" for quad in quads]
    (tmp_path / "cube.obj").write_text("\n".join(lines) + "\n")
    result = etsplat("reconstruct", "cube.obj", "--out", "run", "--preset", "tiny", "--iterations", "5", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "source: 6 polygons were cut into 12 triangles" in result.stdout


def test_folder_of_something_else_stays_untouched(etsplat: Run, sphere: Path, tmp_path: Path) -> None:
    """An output folder with other files is refused, also with --overwrite."""
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "chapter1.txt").write_text("It was a dark and stormy night.")
    for extra in ([], ["--overwrite"]):
        result = etsplat("reconstruct", str(sphere), "--out", str(folder), "--preset", "tiny", *extra)
        assert_one_line_error(result, "thesis", "not empty")
    assert [path.name for path in folder.iterdir()] == ["chapter1.txt"]


def test_debug_shows_the_traceback(etsplat: Run) -> None:
    """--debug lets an error through to where Python shows it."""
    with pytest.raises(InputError, match=r"no\.ply"):
        etsplat("reconstruct", "no.ply", "--out", "run", "--debug")


def test_memory_that_is_not_there_is_one_line(etsplat: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """As an allocation that fails in the native engine."""

    def run(command: Doctor, arguments: Sequence[str]) -> int:
        raise MemoryError("std::bad_alloc")

    monkeypatch.setattr(Doctor, "run", run)
    result = etsplat("doctor")
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert "not enough memory" in result.stderr


def test_what_may_not_be_read_is_named(etsplat: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the number that the system has for it."""

    def run(command: Doctor, arguments: Sequence[str]) -> int:
        raise PermissionError(13, "Permission denied", "secret/scene")

    monkeypatch.setattr(Doctor, "run", run)
    result = etsplat("doctor")
    assert (result.returncode, result.stderr) == (
        2,
        "etsplat: secret/scene: Permission denied; check the path and its permissions\n",
    )


@pytest.mark.parametrize("command", [["train", "scene"], ["reconstruct", "mesh.ply"]])
def test_going_on_and_starting_anew_contradict_each_other(etsplat: Run, tmp_path: Path, command: list[str]) -> None:
    """The earlier run is not touched."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text('{"format": "etsplat run 1"}')
    result = etsplat(*command, "--out", "run", "--resume", "--overwrite", cwd=tmp_path)
    assert_one_line_error(result, "--resume and --overwrite")
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["config.json"]


def test_demo_end_to_end_then_refuses_then_overwrites(etsplat: Run, tmp_path: Path) -> None:
    """A tiny demo prints metrics and paths and writes every result; a second one needs --overwrite."""
    tiny = ["demo", "--preset", "tiny", "--iterations", "20", "--out", "run"]
    result = in_own_process(*tiny, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for word in ("Optimizing", "PSNR", "Chamfer", "report.html", "overview.png", "mesh.glb"):
        assert word in result.stdout
    assert result.stdout.splitlines()[-1].startswith("The result is poor: silhouette IoU 0.")
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names >= {"mesh.ply", "mesh.obj", "mesh.glb", "metrics.json", "config.json", "history.jsonl"}
    assert names >= {"report.html", "overview.png", "convergence.png", "test", "checkpoints", "README.txt"}
    assert "etsplat reconstruct demo:owl --out DIR" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert_one_line_error(in_own_process(*tiny, cwd=tmp_path), "--resume", "--overwrite")
    assert etsplat(*tiny, "--overwrite", cwd=tmp_path).returncode == 0


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one subprocess")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_says_how_to_resume_and_resumes(
    number: signal.Signals, etsplat: Run, sphere: Path, tmp_path: Path
) -> None:
    """Ctrl-C ends with status 130 and the command that continues; that command finishes the run. So does SIGTERM."""
    run = tmp_path / "run"
    options = ["reconstruct", str(sphere), "--out", str(run), "--preset", "tiny", "--iterations", "1500"]
    options += ["--max-faces", "400", "--output.checkpoint-every", "0"]
    process = subprocess.Popen([*PROGRAM, *options], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    history = run / "history.jsonl"
    deadline = time.monotonic() + 60
    while not (history.exists() and history.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert errors.count("\n") == 1
    assert errors.endswith("--resume\n")
    assert "continue with: etsplat reconstruct" in errors
    result = etsplat(*options, "--resume")
    assert result.returncode == 0, result.stderr
    assert json.loads((run / "metrics.json").read_text())["iterations"] == 1500


def test_resume_line_keeps_the_options() -> None:
    """The suggested command quotes what needs it, says --resume once, and never --overwrite."""
    line = resume_line(["demo", "--out", "my run", "--overwrite", "--resume"])
    assert line == "etsplat demo --out 'my run' --resume"


def test_commands_have_torch_compute_on_one_thread(etsplat: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """On how many it would depend the last bits of files; afterwards there are as many as before."""
    seen: list[int] = []

    def run(command: Command, arguments: Sequence[str]) -> int:
        seen.append(torch.get_num_threads())
        return 0

    monkeypatch.setattr(Doctor, "run", run)
    on_each_count(lambda: etsplat("doctor"))
    assert seen == [1] * len(COUNTS)
