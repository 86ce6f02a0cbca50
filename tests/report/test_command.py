"""The command that repeats a run."""

import shlex
from importlib.metadata import version
from pathlib import Path

from etsplat.cli.parse import parse
from etsplat.cli.runs import Train
from etsplat.report.command import reproduce_command
from etsplat.report.data import read_run
from etsplat.tasks.train_config import TrainConfig
from tests.helpers.finished_runs import CONFIG, write_soup_run


def test_command_repeats_the_run() -> None:
    """The command names the source and what differs from the preset; all settings if the run is another version's."""
    here = version("etsplat")
    command = reproduce_command(CONFIG, here)
    assert command is not None
    words = shlex.split(command.replace("\\\n", ""))
    assert words[:4] == ["etsplat", "reconstruct", "meshes/bunny <&> co.ply", "--out"]
    assert words[5:] == ["--preset", "quick", "--method", "bilateral", "--iterations", "3000"]
    older = reproduce_command(CONFIG | {"versions": {"etsplat": "0.0.1"}}, here)
    assert older is not None
    assert "--max-faces" in older


def test_the_command_is_read_back_as_the_same_settings() -> None:
    """Whatever was changed: numbers, switches, words, none, at the top and in groups."""
    changes = {"normalize": False, "width": None, "drawing.cull_small": True, "optimizer.lr_sigma": 1e-7, "sky": "dome"}
    settings = TrainConfig.demo("indoor").changed({**changes, "densification.replace_dead": False})
    paths = {"source": "scenes/a b", "images": None, "masks": None}
    record = {
        "task": "train",
        "config": settings.to_dict(),
        "paths": paths,
        "versions": {"etsplat": version("etsplat")},
    }
    for made_with in (version("etsplat"), "0.0.1"):
        command = reproduce_command(record, made_with)
        assert command is not None
        parsed = parse(shlex.split(command.replace("\\\n", ""))[1:])
        assert isinstance(parsed, Train)
        assert parsed.settings == settings


def test_no_command_for_objects_from_python() -> None:
    """A run that was handed a mesh or views from Python has no command line."""
    here = version("etsplat")
    assert reproduce_command(CONFIG | {"paths": {"source": None, "init_mesh": None}}, here) is None
    start = {"source": {"fingerprint": "1", "init_mesh": "2"}}
    assert reproduce_command(CONFIG | start, here) is None


def test_the_command_of_a_soup_names_scene_photos_and_changes(tmp_path: Path) -> None:
    config = read_run(write_soup_run(tmp_path / "run")).config
    command = reproduce_command(config, version("etsplat"))
    assert command is not None
    words = shlex.split(command.replace("\\\n", ""))
    assert words[:4] == ["etsplat", "train", "scenes/my kitchen", "--out"]
    assert words[5:] == [
        *["--images", "images_2", "--preset", "quick", "--scene-type", "indoor"],
        *["--iterations", "500"],
    ]
