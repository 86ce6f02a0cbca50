"""Which folders may hold a run, and that its files survive kills."""

import errno
import json
import os
from pathlib import Path

import pytest

from etsplat.core.errors import InputError
from etsplat.io import run_directory
from etsplat.io.run_directory import RunDirectory, is_run

CONFIG = {"task": "reconstruct", "config": {"seed": 0, "method": "elastic"}, "source": {"fingerprint": "abc"}}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_one_line(error: pytest.ExceptionInfo[InputError], *words: str) -> None:
    message = str(error.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_a_new_folder_is_made_with_its_parents_and_explains_itself(tmp_path: Path) -> None:
    """A run creates its folder, config.json and a README.txt that names every other file of the layout."""
    run = RunDirectory.create(tmp_path / "a" / "b", CONFIG)
    assert is_run(run.path)
    assert run.read_config()["config"] == CONFIG["config"]
    readme = (run.path / "README.txt").read_text()
    for name in ("report.html", "mesh.ply", "metrics.json", "history.jsonl", "checkpoints", "resume=True"):
        assert name in readme


@pytest.mark.parametrize("full", ["config.json", "README.txt"])
def test_a_disk_that_is_full_from_the_start_leaves_a_folder_to_go_on_with(
    tmp_path: Path, full: str, monkeypatch
) -> None:
    """Whatever had room: nothing of a run, which starts anew there, or a run that is resumed and explains itself."""
    write = run_directory.atomic_write

    def atomic_write(path: Path):
        if path.name == full:
            raise InputError("full")
        return write(path)

    monkeypatch.setattr(run_directory, "atomic_write", atomic_write)
    with pytest.raises(InputError, match="full"):
        RunDirectory.create(tmp_path / "run", CONFIG)
    monkeypatch.undo()
    again = RunDirectory.resume if is_run(tmp_path / "run") else RunDirectory.create
    run = again(tmp_path / "run", CONFIG)
    fresh = RunDirectory.create(tmp_path / "fresh", CONFIG)
    assert contents(run.path) == contents(fresh.path)
    assert run.checkpoints.is_dir()


@pytest.mark.parametrize("text", ["{", "[1]", "[" * 100_000, "9" * 5000])
def test_files_of_a_run_that_are_damaged_are_named(tmp_path: Path, text: str) -> None:
    """Also those that are nested deeper than Python can follow."""
    run = RunDirectory.create(tmp_path / "run", CONFIG)
    run.write_metrics({})
    for path, read in ((run.metrics_path, run.read_metrics), (run.config_path, run.read_config)):
        path.write_text(text)
        with pytest.raises(InputError) as error:
            read()
        assert_one_line(error, str(path), "JSON")
    assert not is_run(run.path)
    run.history_path.write_bytes(text.encode() + b"\xff\n")
    with pytest.raises(InputError) as error:
        run.read_history()
    assert_one_line(error, str(run.history_path), "damaged")


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        ("task", ["train"], ("`task` is", "must be a text")),
        ("task", None, ("`task` is null",)),
        ("iterations", 1.5, ("`iterations` is 1.5", "a whole number")),
        ("iterations", True, ("`iterations` is true",)),
        ("iterations", 10**400, ("`iterations` is 1000",)),
        ("config", [], ("`config` is []", "an object")),
        ("paths", "scene", ("`paths` is", "an object")),
        ("paths", {"source": 5}, ("`paths.source` is 5", "a text or null")),
        ("paths", {"masks": {}}, ("`paths.masks`",)),
        ("paths", {}, ("lacks `paths.source`",)),
    ],
)
def test_a_config_with_values_of_other_types_is_named(
    tmp_path: Path, entry: str, value: object, words: tuple[str, ...]
) -> None:
    """Whoever reads it may rely on what it asked for."""
    record = {**CONFIG, "iterations": 10, "paths": {"source": None}}
    run = RunDirectory.create(tmp_path / "run", record)
    assert run.read_config("paths.source") == {"format": run_directory.FORMAT, **record}
    run.config_path.write_text(json.dumps({"format": run_directory.FORMAT, **record, entry: value}))
    with pytest.raises(InputError) as error:
        run.read_config("paths.source")
    assert_one_line(error, str(run.config_path), "run again", *words)


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        ("[1]\n", "line 1: holds no JSON object"),
        ('{"iteration": 1}\n{"loss": 1}\n', "line 2: lacks `iteration`"),
        ('{"iteration": "1"}\n', 'line 1: `iteration` is "1", but must be a whole number'),
        ('{"iteration": 2}\n{"iteration": 2}\n', "line 2: its iteration is not after"),
    ],
)
def test_a_history_without_increasing_iterations_is_damaged(tmp_path: Path, lines: str, problem: str) -> None:
    run = RunDirectory.create(tmp_path / "run", CONFIG)
    run.history_path.write_text(lines)
    for read in (run.read_history, lambda: run.truncate_history(1)):
        with pytest.raises(InputError) as error:
            read()
        assert_one_line(error, str(run.history_path), problem, "delete the file")
    assert run.history_path.read_text() == lines


def test_an_empty_folder_is_used(tmp_path: Path) -> None:
    """An existing empty folder becomes the run's."""
    assert RunDirectory.create(tmp_path, CONFIG).config_path.exists()


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_with_other_things_is_refused_and_left_alone(tmp_path: Path, overwrite: bool) -> None:
    """A folder that holds files of somebody else is never written to, not even with overwrite."""
    (tmp_path / "thesis.tex").write_text("years of work")
    before = contents(tmp_path)
    with pytest.raises(InputError) as error:
        RunDirectory.create(tmp_path, CONFIG, overwrite=overwrite)
    assert_one_line(error, str(tmp_path), "not a run", "choose")
    assert contents(tmp_path) == before


def test_a_folder_with_a_run_is_refused_and_left_alone(tmp_path: Path) -> None:
    """An earlier run is kept unless it is to be overwritten."""
    RunDirectory.create(tmp_path, CONFIG).write_metrics({"psnr": 40.0})
    before = contents(tmp_path)
    with pytest.raises(InputError) as error:
        RunDirectory.create(tmp_path, CONFIG)
    assert_one_line(error, "resume=True", "overwrite=True")
    assert contents(tmp_path) == before


def test_overwrite_removes_what_a_run_writes_and_nothing_else(tmp_path: Path) -> None:
    """Replacing a run deletes its results; a file that somebody put beside them stays."""
    run = RunDirectory.create(tmp_path, CONFIG)
    run.write_metrics({"psnr": 40.0})
    (run.checkpoints / "step_000001.safetensors").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    RunDirectory.create(tmp_path, {**CONFIG, "config": {"seed": 1}}, overwrite=True)
    assert run.read_config()["config"] == {"seed": 1}
    assert not run.metrics_path.exists()
    assert list(run.checkpoints.iterdir()) == []
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    """An output path that is a file, or lies below one, is an error of one line."""
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(InputError) as error:
            RunDirectory.check_free(path)
        assert_one_line(error, str(path), "is a file")


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_a_folder_that_cannot_be_written_to_is_named(
    tmp_path: Path, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read-only, forbidden and full: one line with the system's reason. (Simulated: tests may run as root.)"""

    def refuse(*_: object, **__: object) -> int:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(InputError) as error:
        RunDirectory.check_free(tmp_path / "run")
    assert_one_line(error, str(tmp_path / "run"), os.strerror(code))


@pytest.mark.parametrize("again", ["resume", "overwrite"])
def test_what_a_killed_process_was_writing_goes(tmp_path: Path, again: str) -> None:
    """Of the run's own files, wherever they are; files that only look like it stay."""
    run = RunDirectory.create(tmp_path / "run", {"task": "fit"})
    left = [
        ".convergence.da9cd65f.png",
        "test/.007_mesh.f0be6e5f.png",
        "stages/soup/checkpoints/.step_000004.01234567.safetensors",
    ]
    others = [".mine.da9cd65f.png", ".convergence.png", ".config.json"]
    for name in [*left, *others]:
        (run.path / name).parent.mkdir(parents=True, exist_ok=True)
        (run.path / name).write_text("half")
    if again == "resume":
        RunDirectory.resume(run.path, {"task": "fit"})
    else:
        RunDirectory.create(run.path, {"task": "fit"}, overwrite=True)
    assert not [name for name in left if (run.path / name).exists()]
    assert all((run.path / name).exists() for name in others)


def test_a_folder_in_which_a_run_was_killed_before_it_began_is_empty(tmp_path: Path) -> None:
    """Be it while its first file was written."""
    (tmp_path / ".config.0123abcd.json").write_text("half")
    RunDirectory.create(tmp_path, {"task": "fit"})
    assert not (tmp_path / ".config.0123abcd.json").exists()


def test_resume_wants_a_run(tmp_path: Path) -> None:
    """Resuming a folder that does not exist or holds no run is an error that says to start it."""
    with pytest.raises(InputError) as error:
        RunDirectory.resume(tmp_path / "run", CONFIG)
    assert_one_line(error, "no run to resume", "without resume")


def test_resume_wants_the_same_settings_and_input(tmp_path: Path) -> None:
    """A resume with another seed or another input names what differs; the same ones are accepted."""
    RunDirectory.create(tmp_path, CONFIG)
    RunDirectory.resume(tmp_path, CONFIG)
    with pytest.raises(InputError) as error:
        RunDirectory.resume(tmp_path, {**CONFIG, "config": {"seed": 7, "method": "elastic"}})
    assert_one_line(error, "seed=0 (not 7)")
    with pytest.raises(InputError) as error:
        RunDirectory.resume(tmp_path, {**CONFIG, "source": {"fingerprint": "xyz"}})
    assert_one_line(error, "fingerprint=abc (not xyz)")


def test_history_survives_a_kill_in_the_middle_of_a_line(tmp_path: Path) -> None:
    """A half-written last line is ignored when reading and gone after a resume."""
    run = RunDirectory.create(tmp_path, CONFIG)
    for iteration in (50, 100, 150):
        run.append_history({"iteration": iteration, "loss": 1.0 / iteration})
    with open(run.history_path, "a") as file:
        file.write('{"iteration": 200, "lo')
    assert [line["iteration"] for line in run.read_history()] == [50, 100, 150]
    run.truncate_history(100)
    run.append_history({"iteration": 150, "loss": 0.5})
    assert [json.loads(line)["iteration"] for line in run.history_path.read_text().splitlines()] == [50, 100, 150]


def test_metrics_are_valid_json_whatever_they_are(tmp_path: Path) -> None:
    """An infinite PSNR becomes null, which JSON has; infinity it has not."""
    run = RunDirectory.create(tmp_path, CONFIG)
    views = [{"psnr": float("inf"), "ssim": 1.0}]
    run.write_metrics({"psnr": float("inf"), "chamfer": 1e-3, "views": views, "range": (0.0, float("nan"))})
    assert run.read_metrics() == {
        "psnr": None,
        "chamfer": 1e-3,
        "views": [{"psnr": None, "ssim": 1.0}],
        "range": [0.0, None],
    }
