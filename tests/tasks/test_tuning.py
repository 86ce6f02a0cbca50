"""Searches: what is searched, that a study goes on as if it had not been interrupted, and its best settings."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sweeps import tuning
from etsplat.tasks.sweeps.cells import Cell
from etsplat.tasks.sweeps.places import Where
from etsplat.tasks.sweeps.tuning import Range, Search, Study, read_ranges

RATE, COLORS = "optimizer.lr_vertices", "drawing.colors"
RANGES = [Range(RATE, 1e-3, 1e-1, log=True), Range("iterations", 5, 50), Range(COLORS, words=("face", "vertex"))]


def search_in(out: Path, **changes: Any) -> Search[ReconstructConfig]:
    options: dict[str, Any] = {"goal": "chamfer", "seed": 3, **changes}
    return Search(ReconstructConfig.tiny(), RANGES, {"a": Path("a.ply"), "b": Path("b.ply")}, out=out, **options)


def pretend(cells: list[Cell], where: Where, show: object) -> None:
    """In the place of `run_cells`: runs at once, whose Chamfer distance follows from their settings."""
    for cell in (cell for cell in cells if cell.state == "waiting"):
        assert isinstance(cell.config, ReconstructConfig)
        rate, colors = cell.config.optimizer.lr_vertices, cell.config.drawing.colors
        chamfer = abs(rate - 0.01) + 1 / cell.config.iterations + (colors == "vertex") + (cell.object == "b")
        run = RunDirectory.create(cell.folder, {"task": "reconstruct", "config": cell.config.to_dict()})
        run.write_metrics({"chamfer": chamfer, "psnr": None})
        cell.look()


def through(study: Study, trials: int, batch: int = 1) -> dict[int, dict[str, Any]]:
    study.run(trials, batch, Where(), lambda cells: lambda: None)
    return study.chosen()


def test_ranges_are_read_by_the_types_of_settings() -> None:
    given = [(RATE, "1e-3", "0.1", "log"), ("iterations", "5", "50"), ("drawing.colors", "face", "vertex")]
    assert read_ranges(ReconstructConfig, given) == RANGES


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("lr_vertices 1 2", "search lr_vertices: is no setting that can be searched; did you mean optimizer.lr_vert"),
        ("preset quick best", "search preset: is no setting that can be searched"),
        ("iterations 5", "search iterations: write its least and its largest number"),
        ("iterations 5 many", "search iterations: write its least and its largest number"),
        ("iterations 50 5", "search iterations: 50 to 5 is no range; write LOW HIGH"),
        ("optimizer.lr_vertices 0 1 log", "0 to 1 is no range of logarithms"),
        ("drawing.colors face", "search drawing.colors: name at least two values"),
    ],
)
def test_what_is_no_range_is_named(words: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_ranges(ReconstructConfig, [words.split()])


def test_ends_of_ranges_are_checked_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="iterations: is 0; it must be at least 1"):
        Search(ReconstructConfig.tiny(), [Range("iterations", 0, 5)], {}, "psnr", 0, tmp_path).check()
    with pytest.raises(InputError, match="goal: is 'luck'; choose one of chamfer, psnr"):
        search_in(tmp_path, goal="luck").check()


def test_optuna_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"needs optuna; pip install 'etsplat\[tune\]'"):
        Study(search_in(tmp_path))


@pytest.fixture
def optuna(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("optuna", reason="optuna is not installed (the extra tune)")
    monkeypatch.setattr(tuning, "run_cells", pretend)


@pytest.mark.usefixtures("optuna")
def test_a_search_finds_and_writes_the_best_settings(tmp_path: Path) -> None:
    """The mean over both inputs; best.json is a file for --config."""
    study = Study(search_in(tmp_path))
    assert study.write_best() is None
    through(study, 12)
    best = study.write_best()
    assert best is not None
    path, value = best
    metrics = [json.loads(p.read_text())["chamfer"] for p in (tmp_path / "runs" / "a").glob("*/metrics.json")]
    assert len(metrics) == 12
    assert value == pytest.approx(min(metrics) + 0.5)
    config = ReconstructConfig.from_file(path)
    assert config.drawing.colors == "face"
    assert config.seed == 3


@pytest.mark.usefixtures("optuna")
@pytest.mark.parametrize("batch", [1, 3])
def test_a_search_that_is_interrupted_proposes_what_it_would_have(
    batch: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While runs of a batch are under way: these are taken up again, and what comes after is the same."""
    undisturbed = through(Study(search_in(tmp_path / "a")), 14, batch)

    def interrupt(cells: list[Cell], where: Where, show: object) -> None:
        if cells[0].variant in ("trial 6", "trial 12"):
            pretend(cells[:1], where, show)
            monkeypatch.setattr(tuning, "run_cells", pretend)
            raise KeyboardInterrupt
        pretend(cells, where, show)

    for _ in range(2):
        monkeypatch.setattr(tuning, "run_cells", interrupt)
        with pytest.raises(KeyboardInterrupt):
            through(Study(search_in(tmp_path / "b")), 14, batch)
        through(Study(search_in(tmp_path / "b")), 7 if batch == 1 else 9, batch)
    assert through(Study(search_in(tmp_path / "b")), 14, batch) == undisturbed


@pytest.mark.usefixtures("optuna")
def test_another_search_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    through(Study(search_in(tmp_path)), 1)
    with pytest.raises(InputError, match=r"holds a search with seed=3 \(not 4\); go on with the same, or choose"):
        Study(search_in(tmp_path, seed=4))


@pytest.mark.usefixtures("optuna")
def test_trials_that_fail_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search goes on. A goal that runs do not measure ends it."""

    def fail(cells: list[Cell], where: Where, show: object) -> None:
        for cell in cells:
            cell.state = "failed"

    with pytest.raises(InputError, match=r"goal psnr: was not measured in .*; choose another"):
        through(Study(search_in(tmp_path / "a", goal="psnr")), 1)
    monkeypatch.setattr(tuning, "run_cells", fail)
    study = Study(search_in(tmp_path / "b"))
    assert len(through(study, 2)) == 2
    assert study.write_best() is None
