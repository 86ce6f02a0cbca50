"""Sweeps: what is asked for, and which runs that makes."""

from pathlib import Path

import pytest

from etsplat.core.errors import InputError
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sweeps.sweep import Sweep, name_of, read_inputs, read_values
from etsplat.tasks.train_config import TrainConfig

BASE = ReconstructConfig.tiny()
OWL = {"owl": Path("demo:owl")}


def test_settings_are_read_by_their_types() -> None:
    """Numbers, words, nothing; with hyphens as on the command line."""
    given = (("optimizer.lr-vertices", "3e-4", "0.006"), ("drawing.colors", "face"), ("texture", "none", "512"))
    assert read_values(ReconstructConfig, given) == {
        "optimizer.lr_vertices": (3e-4, 0.006),
        "drawing.colors": ("face",),
        "texture": (None, 512),
    }


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([("lr_vertices", "1")], "set lr_vertices: is no setting; did you mean optimizer.lr_vertices"),
        ([("iterations",)], "set iterations: has no value"),
        ([("iterations", "5", "5")], "set iterations: has a value twice"),
        ([("iterations", "5"), ("iterations", "6")], "set iterations: is given twice"),
        ([("seed", "1", "2")], "set seed: is no setting; seeds have an option of their own, --seeds"),
    ],
)
def test_settings_that_are_none_are_named(given: list[tuple[str, ...]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_values(ReconstructConfig, given)


def test_every_combination_is_run_on_every_input_with_every_seed(tmp_path: Path) -> None:
    """Each in a folder that says what it is; the settings of each are checked before anything runs."""
    values = {"iterations": (5, 6), "drawing.colors": ("face", "vertex")}
    inputs = {**OWL, "cup": tmp_path}
    cells = Sweep(BASE, values, inputs, (0, 3)).cells(tmp_path)
    assert len({cell.folder for cell in cells}) == len(cells) == 16
    assert cells[1].folder == tmp_path / "runs" / "owl" / "iterations=5, colors=face seed 3"
    assert [(c.config.iterations, c.config.drawing.colors, c.seed) for c in cells[:3]] == [  # pyright: ignore
        (5, "face", 0),
        (5, "face", 3),
        (5, "vertex", 0),
    ]
    with pytest.raises(InputError, match="iterations: is 0; it must be at least 1"):
        Sweep(BASE, {"iterations": (0,)}, OWL).cells(tmp_path)


def test_a_preset_among_the_settings_stands_for_its_own(tmp_path: Path) -> None:
    """As `--preset` does, with what else is set on top; not beside the settings of a file."""
    sweep = Sweep(TrainConfig.tiny("indoor"), {"preset": ("tiny", "quick"), "width": (50,)}, OWL)
    configs = [cell.config for cell in sweep.cells(tmp_path)]
    assert configs == [TrainConfig.of(name, "indoor").changed({"width": 50}) for name in ("tiny", "quick")]
    with pytest.raises(InputError, match="set preset: contradicts --config"):
        Sweep(BASE, {"preset": ("tiny",)}, OWL, relabel=False).cells(tmp_path)


def test_names_are_short_where_they_are_clear_and_fit_a_folder(tmp_path: Path) -> None:
    assert name_of({"optimizer.lr_vertices": 3e-4, "iterations": 5}) == "lr_vertices=0.0003, iterations=5"
    assert name_of({"a.x": 1, "b.x": 2}) == "a.x=1, b.x=2"
    assert name_of({}) == "as it is"
    sweep = Sweep(BASE, {"output.lpips_weights": (tmp_path / "a", tmp_path / "b")}, OWL)
    folders = [cell.folder for cell in sweep.cells(tmp_path)]
    assert len(set(folders)) == 2
    assert all(folder.parent == tmp_path / "runs" / "owl" for folder in folders)


def test_inputs_have_names_of_their_own(tmp_path: Path) -> None:
    """And are of the task."""
    for name in ("a/cup.ply", "b/cup.obj"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    assert read_inputs([str(tmp_path / "a/cup.ply"), "demo:owl"], "reconstruct") == {
        "cup": tmp_path / "a/cup.ply",
        "owl": Path("demo:owl"),
    }
    with pytest.raises(InputError, match="another input is named cup too"):
        read_inputs([str(tmp_path / "a/cup.ply"), str(tmp_path / "b/cup.obj")], "reconstruct")
    with pytest.raises(InputError, match="no such file or folder"):
        read_inputs([str(tmp_path / "gone.ply")], "reconstruct")
    with pytest.raises(InputError, match="demo:owl: is for `etsplat reconstruct`"):
        read_inputs(["demo:owl"], "train")
