"""Options become settings: presets, names, numbers out of range."""

import json
from pathlib import Path

import pytest

from etsplat.cli.parse import parse
from etsplat.cli.runs import DemoObject, DemoScene, Reconstruct, Train
from etsplat.cli.soups import Export, Render
from etsplat.core.errors import InputError
from etsplat.io.run_directory import FORMAT
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train_config import TrainConfig
from tests.helpers.commands import Run, assert_one_line_error


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


def test_the_sky_is_left_out_by_the_same_word_in_export_and_render() -> None:
    """`export` has more to choose from: --no-sky is --sky none."""
    export, render = parse(["export", "run", "--no-sky"]), parse(["render", "run", "--no-sky"])
    assert isinstance(export, Export)
    assert isinstance(render, Render)
    assert (export.settings.sky, render.settings.sky) == ("none", False)
    assert export == parse(["export", "run", "--sky", "none"])


@pytest.mark.parametrize("command", ["export", "render"])
def test_a_crop_that_is_none_is_refused_before_anything_is_read(command: str) -> None:
    with pytest.raises(InputError, match=r"--crop: is 'cube:1'; write auto, sphere:X,Y,Z,R or box:X0,Y0,Z0,X1,Y1,Z1"):
        parse([command, "nowhere", "--crop", "cube:1"]).run([])
