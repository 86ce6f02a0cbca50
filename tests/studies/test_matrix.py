"""The matrix runs its cells, names the worst of each row, and compares rows with an earlier matrix."""

import json
from pathlib import Path

import pytest

from etsplat.core.errors import InputError
from helpers.captures import write_colmap
from studies.matrix import Matrix
from studies.scenes.matrix import read_bar


def make(folder: Path, *more: str) -> str:
    """Runs the command on two small captures; the table's text."""
    scenes = [f"{folder / name}:indoor" for name in ("first", "second")]
    changes = ["--preset", "tiny", "--set", "iterations=6,schedule.max_epochs=2"]
    options = ["--scenes", *scenes, "--out", str(folder / "out"), *changes, "--widths", "24", "48"]
    options += ["--limits", "30", "60", *more]
    assert Matrix.parse(options).run(options) == 0
    return (folder / "out" / "matrix.md").read_text()


def test_a_matrix_has_a_row_for_each_capture_and_width(tmp_path: Path) -> None:
    for name in ("first", "second"):
        write_colmap(tmp_path / name, [(48, 36)] * 3)
    text = make(tmp_path)
    cells = json.loads((tmp_path / "out" / "matrix.json").read_text())["cells"]
    assert {(cell["scene"], cell["width"], cell["limit"]) for cell in cells} == {
        (name, width, limit) for name in ("first", "second") for width in (24, 48) for limit in (30, 60)
    }
    own = sorted(cell["psnr"] for cell in cells if (cell["scene"], cell["width"]) == ("second", 48))
    line = next(line for line in text.splitlines() if line.startswith("| second | 48 |"))
    assert f"**{own[1]:.2f}**" in line
    assert line.endswith(f"| {own[1] - own[0]:.2f} |")
    assert read_bar(tmp_path / "out")["second", 48] == own[1]
    beside = make(tmp_path, "--against", str(tmp_path / "out"))
    assert next(line for line in beside.splitlines() if line.startswith("| second | 48 |")).endswith(f"{own[1]:.2f} |")


def test_what_is_no_matrix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"against .*matrix\.json: is no result of studies\.matrix"):
        read_bar(tmp_path)
    (tmp_path / "matrix.json").write_text('{"cells": [{"scene": "fox"}]}')
    with pytest.raises(InputError, match=r"is no result of studies\.matrix"):
        read_bar(tmp_path)
