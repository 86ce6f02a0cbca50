"""What the command says of itself: help, versions, what was probably meant."""

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from types import SimpleNamespace
from typing import TypeGuard, cast

import docstring_parser
import pytest
import tyro

from etsplat.cli.command import Command
from etsplat.cli.doctor import Doctor
from etsplat.cli.parse import COMMANDS, Group, _struct, parse
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.settings import settings_of
from etsplat.tasks.train_config import TrainConfig
from tests.helpers.commands import Run, assert_one_line_error


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


def test_help_says_what_must_be_given_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    """A command among others is required unless one is the default; no default is an empty word."""
    groups = {(): Group("All.", COMMANDS)} | {(name,): group for name, group in COMMANDS.items() if _is_group(group)}
    for words, group in groups.items():
        text = _help_of(words, capsys)
        assert ("(required)" in text) == (group.default is None)
        assert (f"(default: {group.default})" in text) == (group.default is not None)
        for name, entry in group.commands.items():
            assert "(default: )" not in _help_of([*words, name], capsys)
            if not _is_group(entry):
                assert "(default: )" not in _help_of([*words, name, "--help-all"], capsys)
    assert "(default: object)" in _help_of(["demo"], capsys)
    assert "(required, one or more)" in _help_of(["sweep", "train"], capsys)


def _is_group(entry: object) -> TypeGuard[Group]:
    return isinstance(entry, Group)


def _help_of(words: Sequence[str], capsys: pytest.CaptureFixture[str]) -> str:
    """In one line, without frames."""
    with pytest.raises(SystemExit):
        parse([*words, "--help"])
    return " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_an_alias_of_a_type_is_no_command(looks_like_a_class: object) -> None:
    """Nor does tyro's question for it end in an error: options of several numbers have such a type."""
    info = SimpleNamespace(type=looks_like_a_class)
    assert _struct(cast(tyro.constructors.StructTypeInfo, info), brief=False) is None


def test_help_of_a_command_teaches(etsplat: Run) -> None:
    """Each setting is an option with its help and the preset's default, and there are examples."""
    result = etsplat("reconstruct", "--help-all", "--preset", "paper")
    assert result.returncode == 0
    for word in ("--regularization.lambda-sigma", "--max-faces", "30000)", "--resume", "Examples:"):
        assert word in result.stdout


def test_help_does_not_wait_for_what_computes() -> None:
    """Neither help nor parsing options imports torch, the native engine or anything else of weight; help is read in a
    moment, 0.3 s of one processor, of which Python, tyro and the classes of the settings have the most."""
    program = """
import sys
from etsplat.cli.main import main
sys.argv = ["etsplat", *sys.argv[1:]]
try:
    main()
except SystemExit:
    heavy = {"torch", "numpy", "scipy", "PIL", "matplotlib", "trimesh", "rich", "etsplat._native", "importlib.metadata"}
    print(sorted(heavy & set(sys.modules)), len(sys.modules))
"""
    shown = subprocess.run([sys.executable, "-c", program, "--help"], capture_output=True, text=True, check=True)
    found, _, count = shown.stdout.splitlines()[-1].rpartition(" ")
    assert found == "[]"
    assert int(count) < 300
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
