"""The table of `studies.matrix`: how far the worst cell of each row is below the best."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.tasks.train_config import TrainConfig
from studies.grid.cells import Cell
from studies.grid.writing import bold, origin_of, versions_of, write_text

Row = tuple[str, int]
"""Name of a capture, and width of its photos."""


def read_bar(folder: Path) -> dict[Row, float]:
    """The best PSNR of each row of an earlier matrix.

    Raises:
        InputError: there is none in the folder.
    """
    path = folder / "matrix.json"
    try:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        bar: dict[Row, float] = {}
        for cell in cells:
            row = (str(cell["scene"]), int(cell["width"]))
            bar[row] = max(bar.get(row, float("-inf")), float(cell["psnr"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"against {path}: is no result of studies.matrix ({error}); name the folder of one") from error
    return bar


def write_matrix(cells: Sequence[Cell], out: Path, command: str, bar: Mapping[Row, float]) -> None:
    """Writes matrix.json and matrix.md of what is finished.

    Args:
        cells: of the matrix.
        out: folder.
        command: the command line, for the record.
        bar: of `read_bar`; empty without an earlier matrix.
    """
    found = [_measured(cell) for cell in cells if cell.state == "done"]
    origin = origin_of(command)
    document = {**origin, "versions": versions_of(), "cells": found}
    write_text(out / "matrix.json", json.dumps(document, indent=2) + "\n")
    write_text(out / "matrix.md", _markdown(found, origin, bar))


def _measured(cell: Cell) -> dict[str, Any]:
    metrics = cell.metrics()
    assert isinstance(cell.config, TrainConfig)
    return {
        "scene": cell.object,
        "width": cell.config.width,
        "limit": cell.config.max_triangles,
        "psnr": metrics["psnr"],
        "ssim": metrics["ssim"],
        "psnr_opaque": metrics["psnr_opaque"],
        "triangles": metrics["triangles"],
        "iterations": metrics["iterations"],
        "seconds": metrics["seconds"],
    }


def _markdown(found: Sequence[dict[str, Any]], origin: Mapping[str, str], bar: Mapping[Row, float]) -> str:
    limits = sorted({cell["limit"] for cell in found})
    rows = list(dict.fromkeys((cell["scene"], cell["width"]) for cell in found))
    head = ["capture", "width", *(f"{limit:,}" for limit in limits), "worst below best", *(["earlier"] if bar else [])]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for scene, width in rows:
        own = {cell["limit"]: cell for cell in found if (cell["scene"], cell["width"]) == (scene, width)}
        best = max(cell["psnr"] for cell in own.values())
        texts = [_cell(own.get(limit), best) for limit in limits]
        gap = f"{best - min(cell['psnr'] for cell in own.values()):.2f}"
        before = [f"{bar[scene, width]:.2f}" if (scene, width) in bar else "-"] if bar else []
        lines.append("| " + " | ".join([scene, str(width), *texts, gap, *before]) + " |")
    note = "PSNR of the test photos in dB (triangles, seconds) by limit of triangles; the best of a row in bold."
    start = f"`{origin['command']}`, {origin['date']}, commit {origin['commit']}, {origin['machine']}."
    return "\n\n".join([start, note, "\n".join(lines)]) + "\n"


def _cell(cell: dict[str, Any] | None, best: float) -> str:
    if cell is None:
        return "-"
    psnr = bold(f"{cell['psnr']:.2f}", cell["psnr"] == best, "**")
    return f"{psnr} ({cell['triangles']:,}, {cell['seconds']:.0f} s)"
