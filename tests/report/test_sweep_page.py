"""The tables and the page of a sweep."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from etsplat.io.run_directory import RunDirectory
from etsplat.report.sweep_page import write_sweep_page
from etsplat.report.sweep_rows import Found, gather, summary, write_rows
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sweeps.sweep import Sweep, name_of

RATE = "optimizer.lr_vertices"


def run_of(folder: Path, config: ReconstructConfig, metrics: dict[str, Any]) -> None:
    """A run directory that is done."""
    RunDirectory.create(folder, {"task": "reconstruct", "config": config.to_dict()}).write_metrics(metrics)


@pytest.fixture
def found(tmp_path: Path) -> Found:
    """Three rates and two seeds on two objects; a run failed, and the Chamfer distance of one object is not known."""
    sweep = Sweep(
        ReconstructConfig.tiny(),
        {"iterations": (9,), RATE: (0.001, 0.01, 0.1)},
        {"owl": Path("demo:owl"), "<cup>": Path("cup.ply")},
        (0, 1),
    )
    cells = sweep.cells(tmp_path)
    for index, cell in enumerate(cells[:-1]):
        rate = sweep.combinations()[(index // 2) % 3][RATE]
        psnr = 20 + 10 * rate + cell.seed
        chamfer = None if cell.object == "<cup>" else 0.02 + rate
        assert isinstance(cell.config, ReconstructConfig)
        run_of(cell.folder, cell.config, {"psnr": psnr, "chamfer": chamfer, "seconds": 3.0, "faces": 2000})
        cell.look()
    cells[-1].state, cells[-1].error = "failed", "cup.ply: it is <broken>"
    return gather(cells, {name_of(one): one for one in sweep.combinations()}, "reconstruct", "etsplat sweep ...")


def test_means_are_over_seeds_and_the_best_is_by_what_all_have(found: Found) -> None:
    """PSNR here, since one object has no Chamfer distance."""
    assert found.goal.key == "psnr"
    assert found.varied == [RATE]
    assert [line.text(found.goal) for line in found.lines[:3]] == ["20.51 ± 0.71", "20.60 ± 0.71", "21.50 ± 0.71"]
    assert found.lines[-1].text(found.goal) == "21.00"  # of one seed
    assert summary(found) == (
        "owl: best with lr_vertices=0.1 (PSNR, dB 21.50 ± 0.71). <cup>: best with lr_vertices=0.1 (PSNR, dB 21.00)."
    )
    chamfer = next(measure for measure in found.measures if measure.key == "chamfer")
    best = found.best("owl", chamfer)
    assert best is not None
    assert best.chosen[RATE] == 0.001  # less is better
    assert found.best("<cup>", chamfer) is None
    faces = replace(next(m for m in found.measures if m.key == "faces"), better=1)
    assert found.best("owl", faces) is None  # all the same


def test_files_hold_every_run(found: Found, tmp_path: Path) -> None:
    """CSV a row for each; JSON all metrics, where the runs are, and what failed."""
    write_rows(found, tmp_path)
    rows = list(csv.DictReader((tmp_path / "sweep.csv").open()))
    assert len(rows) == 11
    assert rows[0] == {
        "input": "owl",
        "iterations": "9",
        RATE: "0.001",
        "seed": "0",
        "chamfer": "0.021",
        "psnr": "20.01",
        "faces": "2000",
        "seconds": "3.0",
    }
    document = json.loads((tmp_path / "sweep.json").read_text())
    assert (tmp_path / document["runs"][0]["folder"] / "metrics.json").is_file()
    assert document["runs"][0]["metrics"] == found.rows[0].metrics
    assert document["failed"][0]["error"] == "cup.ply: it is <broken>"


def test_the_page_shows_charts_tables_and_failures(found: Found, tmp_path: Path) -> None:
    """It needs no network, and names are text, not markup."""
    page = write_sweep_page(found, tmp_path).read_text()
    assert "11 of 12 runs are done." in page
    assert page.count("<circle") == 11
    assert page.count("<table") == 2
    assert 'class="number best"' in page
    assert "it is &lt;broken&gt;" in page
    assert "lr_vertices=0.1 seed 1.log" in page
    assert "<cup>" not in page
    assert "http" not in page.replace("http://www.w3.org", "")
