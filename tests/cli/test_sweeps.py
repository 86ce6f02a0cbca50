"""`etsplat sweep` and `etsplat tune` from the command line to their tables, with runs that are tiny."""

import csv
import json
from pathlib import Path

import pytest

from helpers.commands import Run

TINY = ("--preset", "tiny", "--jobs", "1", "--cores", "1")
SMALL = ("output.chamfer_samples", "100", "refinement.subdivisions", "0")
SET = [word for name, value in zip(SMALL[::2], SMALL[1::2], strict=True) for word in ("--set", name, value)]


def test_a_sweep_ends_with_a_table_and_goes_on_with_more(etsplat: Run, sphere: Path, tmp_path: Path) -> None:
    """A row for each run, the best named; a second call runs what is new alone."""
    out = tmp_path / "sweep"
    words = ("sweep", "reconstruct", str(sphere), "--out", str(out), *TINY, *SET, "--set", "iterations")
    first = etsplat(*words, "2")
    assert first.returncode == 0, first.stderr
    (done,) = out.glob("runs/*/*/metrics.json")
    before = done.stat().st_mtime_ns
    assert etsplat(*words, "2", "3").returncode == 0
    assert done.stat().st_mtime_ns == before
    rows = list(csv.DictReader((out / "sweep.csv").open(encoding="utf-8")))
    assert sorted(int(row["iterations"]) for row in rows) == [2, 3]
    assert all(float(row["chamfer"]) > 0 for row in rows)
    found = json.loads((out / "sweep.json").read_text(encoding="utf-8"))
    assert "iterations" in json.dumps(found)
    assert (out / "sweep.html").stat().st_size > 1000


def test_a_sweep_whose_run_fails_says_so_and_does_the_others(etsplat: Run, sphere: Path, tmp_path: Path) -> None:
    """The log of what failed is named; the exit status is not 0."""
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\n")
    words = ("sweep", "reconstruct", str(broken), str(sphere), "--out", str(tmp_path / "sweep"), *TINY, *SET)
    result = etsplat(*words, "--set", "iterations", "2")
    assert result.returncode != 0
    assert "broken" in result.stdout + result.stderr
    rows = list(csv.DictReader((tmp_path / "sweep" / "sweep.csv").open(encoding="utf-8")))
    assert len([row for row in rows if row["chamfer"]]) == 1


def test_a_search_ends_with_settings_that_config_takes(etsplat: Run, sphere: Path, tmp_path: Path) -> None:
    """As many trials as asked; best.json is read by --config."""
    pytest.importorskip("optuna")
    out = tmp_path / "tuned"
    words = ("tune", "reconstruct", str(sphere), "--out", str(out), *TINY, *SET, "--set", "iterations", "2")
    result = etsplat(*words, "--search", "optimizer.lr_vertices", "0.003", "0.03", "log", "--trials", "2")
    assert result.returncode == 0, result.stderr
    assert len(list(csv.DictReader((out / "search.csv").open(encoding="utf-8")))) == 2
    best = json.loads((out / "best.json").read_text(encoding="utf-8"))
    rate = best["optimizer"]["lr_vertices"] if "optimizer" in best else best["optimizer.lr_vertices"]
    assert 0.003 <= rate <= 0.03
    again = etsplat("reconstruct", str(sphere), "--config", str(out / "best.json"), "--out", str(tmp_path / "run"))
    assert again.returncode == 0, again.stderr
