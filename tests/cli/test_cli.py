"""The `etsplat` command: in this process, since another one costs seconds, and in its own where that matters."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import cast

import docstring_parser
import pytest

from etsplat.cli.command import Command, resume_line
from etsplat.cli.doctor import Doctor
from etsplat.cli.main import main
from etsplat.cli.parse import COMMANDS, Group, parse
from etsplat.cli.runs import DemoObject, DemoScene, Reconstruct, Train
from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import save_mesh
from etsplat.io.run_directory import FORMAT
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.settings import settings_of
from etsplat.tasks.train_config import TrainConfig

PROGRAM = [sys.executable, "-c", "from etsplat.cli import main; main()"]


Result = subprocess.CompletedProcess[str]
Run = Callable[..., Result]


def in_own_process(*arguments: str, cwd: Path) -> Result:
    return subprocess.run([*PROGRAM, *arguments], cwd=cwd, capture_output=True, text=True, check=False)


@pytest.fixture
def etsplat(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Runs the command with the given arguments, in a folder if there is one; errors that are not handled raise."""

    def run(*arguments: str, cwd: Path | None = None) -> Result:
        capfd.readouterr()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["etsplat", *arguments])
            if cwd is not None:
                patch.chdir(cwd)
            with pytest.raises(SystemExit) as ended:
                main()
        output = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, cast(int, ended.value.code), output.out, output.err)

    return run


def assert_one_line_error(result: Result, *words: str) -> None:
    """Status 2, nothing but one line on standard error, which holds the words."""
    assert result.returncode == 2, result.stderr
    assert result.stderr.startswith("etsplat: ")
    assert result.stderr.count("\n") == 1
    assert all(word in result.stderr for word in words), result.stderr


@pytest.fixture
def sphere(tmp_path: Path) -> Path:
    """A small mesh file."""
    vertices, faces = icosphere(2)
    save_mesh(tmp_path / "sphere.ply", vertices, faces)
    return tmp_path / "sphere.ply"


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_help_lists_the_commands(etsplat: Run, arguments: list[str]) -> None:
    """Without arguments and with --help, the commands and an example are shown."""
    result = etsplat(*arguments)
    assert result.returncode == 0
    for word in ("demo", "reconstruct", "doctor", "etsplat reconstruct bunny.obj --out runs/bunny"):
        assert word in result.stdout


@pytest.mark.parametrize("command", ["reconstruct", "train"])
def test_help_is_short_and_help_all_has_the_rest_under_headings(etsplat: Run, command: str) -> None:
    """About a dozen options at first; then every setting, each group with its own help."""
    brief, whole = (etsplat(command, option).stdout for option in ("--help", "--help-all"))
    config = ReconstructConfig if command == "reconstruct" else TrainConfig
    assert 10 <= len(options_in(brief)) <= 16
    options = {"--" + name.replace("_", "-") for name in settings_of(config)}
    assert options <= set(options_in(whole))
    assert "--help-all" in brief
    assert "optimizer options" in whole
    assert "optimizer options" not in brief
    assert "How vertices, colours, opacities and softness move." in whole


def options_in(text: str) -> list[str]:
    """The options that a help lists, once each."""
    return re.findall(r"^│ (?:-h, )?(--[a-z.-]+)", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("reconstrct", "reconstrct: is no command; did you mean reconstruct? `etsplat --help` lists them"),
        ("demo scne", "scne: is no command; did you mean scene? `etsplat demo --help` lists them"),
        ("data xyz --out a", "xyz: is no command; `etsplat data --help` lists them"),
    ],
)
def test_commands_that_were_probably_meant_are_named(etsplat: Run, words: str, message: str) -> None:
    result = etsplat(*words.split())
    assert_one_line_error(result, message)


def test_options_that_were_probably_meant_are_named(etsplat: Run) -> None:
    """Of the command that is asked for, whichever group they are in."""
    result = etsplat("train", "scene", "--out", "run", "--lr-vertices", "1")
    assert result.returncode == 2
    assert "--optimizer.lr-vertices FLOAT" in result.stderr
    assert "reconstruct" not in result.stderr


@pytest.mark.parametrize("words", [["--method", "single_sided"], ["--method=single_sided"], ["--method=single-sided"]])
def test_methods_may_be_written_as_kernels(words: list[str]) -> None:
    command = parse(["demo", "scene", *words])
    assert isinstance(command, DemoScene)
    assert command.settings.method == "single-sided"


def test_demo_alone_is_demo_object() -> None:
    """Options may follow in both cases."""
    for words in (["demo"], ["demo", "object"]):
        command = parse([*words, "--start.level", "3"])
        assert isinstance(command, DemoObject)
        assert command.settings == ReconstructConfig.demo().changed({"start.level": 3})


def test_settings_of_a_run_are_taken_over_and_options_change_them(tmp_path: Path) -> None:
    """--config takes config.json of a run, or some settings; what is given as an option goes over it."""
    config = TrainConfig.paper("indoor").changed({"iterations": 77, "start.scale": 3.0})
    record = {"format": FORMAT, "task": "train", "config": config.to_dict()}
    (tmp_path / "config.json").write_text(json.dumps(record))
    (tmp_path / "mine.json").write_text('{"start": {"scale": 3}}')
    words = ["train", "scene", "--out", "run", "--config"]
    again = parse([*words, str(tmp_path / "config.json"), "--start.scale", "4"])
    assert isinstance(again, Train)
    assert again.settings == config.changed({"start.scale": 4.0})
    part = parse([*words, str(tmp_path / "mine.json"), "--preset", "paper"])
    assert isinstance(part, Train)
    assert part.settings == TrainConfig.paper().changed({"start.scale": 3.0})
    with pytest.raises(InputError, match=r"preset: .*config\.json is of preset paper already; leave one of them out"):
        parse([*words, str(tmp_path / "config.json"), "--preset", "quick"])
    with pytest.raises(InputError, match=r"has the settings of `etsplat train`; name a run of `etsplat reconstruct`"):
        parse(["reconstruct", "a.ply", "--out", "run", "--config", str(tmp_path / "config.json")])


def test_lines_of_help_end_where_clauses_do() -> None:
    """Help keeps the line breaks of docstrings, so that one within a clause would be seen."""
    configs = (ReconstructConfig, TrainConfig, RenderConfig, ExportConfig)
    groups = [field.default for config in configs for field in fields(config) if is_dataclass(field.default)]
    for settings in (*_commands(COMMANDS), *configs, *map(type, groups)):
        for option in docstring_parser.parse_from_object(settings).params:
            for line in (option.description or "").splitlines()[:-1]:
                assert line.endswith((".", ":", ";")), f"{settings.__name__}.{option.arg_name}: {line}"


def _commands(entries: Mapping[str, type[Command] | Group]) -> Iterator[type[Command]]:
    for entry in entries.values():
        if isinstance(entry, Group):
            yield from _commands(entry.commands)
        else:
            yield entry


def test_help_of_a_command_teaches(etsplat: Run) -> None:
    """Each setting is an option with its help and the preset's default, and there are examples."""
    result = etsplat("reconstruct", "--help-all", "--preset", "paper")
    assert result.returncode == 0
    for word in ("--regularization.lambda-sigma", "--max-faces", "30000)", "--resume", "Examples:"):
        assert word in result.stdout


def test_help_does_not_wait_for_torch() -> None:
    """Parsing options imports neither torch nor the native engine."""
    program = "import sys; from etsplat.cli.parse import parse; parse(['demo']); print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "False\n"


def test_version(etsplat: Run) -> None:
    """--version prints the version and nothing else."""
    assert etsplat("--version").stdout == "etsplat 0.1.0\n"


def test_doctor_tells_what_there_is(etsplat: Run) -> None:
    """Engine, instruction set, threads, versions and what is missing are named; a sound installation ends with 0."""
    result = etsplat("doctor")
    assert result.returncode == 0, result.stderr
    for word in (
        "engine",
        "instruction set",
        "threads",
        "torch",
        "agrees with the reference",
        "LPIPS",
        "CUDA",
        "sfm",
        "view",
    ):
        assert word in result.stdout


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["export", "run", "--min-opacity", "5"], "min_opacity: is 5"),
        (["render", "run", "--width", "100000"], "width: is 100000"),
        (["view", "run", "--width", "0"], "width: is 0"),
        (["view", "run", "--port", "99999"], "port: is 99999"),
    ],
)
def test_numbers_out_of_range_are_named(arguments: list[str], name: str) -> None:
    """Before anything is read, let alone drawn or served."""
    with pytest.raises(InputError, match=name):
        parse(arguments).run([])


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_a_setting_that_a_preset_may_turn_on_is_turned_on_and_off_by_name(preset: str) -> None:
    """Whatever the preset says, --normalize and --no-normalize exist; --resume has no such pair."""
    words = ["train", "scene", "--out", "b", "--preset", preset]
    for flag, value in (("--normalize", True), ("--no-normalize", False)):
        command = parse([*words, flag])
        assert isinstance(command, Train)
        assert command.settings.normalize is value
    with pytest.raises(SystemExit):
        parse([*words, "--no-resume"])


def test_preset_sets_the_defaults_and_options_change_them() -> None:
    """--preset chooses the settings, other options change single ones, and each command has its own default preset."""
    command = parse(["reconstruct", "a.ply", "--out", "b", "--preset=paper", "--iterations", "7", "--engine", "cpu"])
    assert isinstance(command, Reconstruct)
    assert (command.settings.iterations, command.settings.engine) == (7, "cpu")
    assert command.settings.resolution == ReconstructConfig.paper().resolution
    demo = parse(["demo"])
    assert isinstance(demo, DemoObject)
    assert demo.settings == ReconstructConfig.demo()
    best = parse(["reconstruct", "a.ply", "--out", "b"])
    assert isinstance(best, Reconstruct)
    assert best.settings == ReconstructConfig.best()


@pytest.mark.parametrize(
    "arguments", [["demo", "--preset", "huge"], ["demo", "--iterations", "many"], ["reconstruct"], ["paint"]]
)
def test_wrong_options_end_with_status_2(etsplat: Run, arguments: list[str]) -> None:
    """What is no option or no value of one is refused."""
    assert etsplat(*arguments).returncode == 2


def test_setting_out_of_range(etsplat: Run) -> None:
    """A value out of its range is an error in one line that names the setting."""
    assert_one_line_error(etsplat("demo", "--iterations", "0"), "iterations", "at least 1")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("resolution", "60000"),
        ("pictures.supersampling", "100000"),
        ("pictures.coarse_levels", "1000"),
        ("start.level", "1000"),
        ("start.radius", "1e308"),
        ("optimizer.lr_vertices", "1e308"),
        ("iterations", "1" + "0" * 400),
        ("batch", "1000000"),
        ("seed", "9" * 23),
    ],
)
def test_numbers_that_cannot_be_meant_are_refused_by_name(etsplat: Run, name: str, value: str) -> None:
    """Before memory or time is spent on them."""
    option = f"--{name.replace('_', '-')}"
    assert_one_line_error(etsplat("demo", option, value), name, "it must be")


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


@dataclass(frozen=True, kw_only=True)
class _Paint(Command):
    """Paint.

    Examples:
        etsplat studio paint --color red
    """

    color: str = "blue"
    """Of the paint."""

    def run(self, arguments: Sequence[str]) -> int:
        return 0


def test_groups_of_commands(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A group's commands follow its name, with their own options and examples."""
    monkeypatch.setitem(COMMANDS, "studio", Group("Art.", {"doctor": Doctor, "paint": _Paint}))
    assert parse(["studio", "paint", "--color", "red"]) == _Paint(color="red")
    with pytest.raises(SystemExit):
        parse(["studio", "paint", "--help"])
    assert "etsplat studio paint --color red" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        parse(["studio", "--help"])
    assert "paint" in capsys.readouterr().out
