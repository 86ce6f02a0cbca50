"""A grid's results as files: results.csv, results.json, results.md, results.tex."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from studies.grid.writing import bold, csv_text, latex_tabular, origin_of, versions_of, write_text
from studies.objects.paper import paper_chamfer
from studies.objects.results import Summary, chamfer_of, summarize


@dataclass(frozen=True)
class _Column:
    """Title, the summary's value, its format, and whether "min" or "max" is best (None: neither)."""

    title: str
    value: Callable[[Summary], float | None]
    format: str
    best: str | None = None


_COLUMNS = (
    _Column("runs", lambda s: s.runs, "d"),
    _Column("CD mean", lambda s: s.chamfer, ".3f", "min"),
    _Column("CD median", lambda s: s.chamfer_median, ".3f", "min"),
    _Column("seeds ±", lambda s: s.spread, ".3f"),
    _Column("wins", lambda s: s.wins, "d", "max"),
    _Column("paper's CD", lambda s: s.paper_chamfer, ".3f"),
    _Column("exact CD", lambda s: s.chamfer_exact, ".3f", "min"),
    _Column("F-score %", lambda s: s.f_score, ".1f", "max"),
    _Column("PSNR", lambda s: s.psnr, ".2f", "max"),
    _Column("PSNR of mesh", lambda s: s.psnr_mesh, ".2f", "max"),
    _Column("SSIM", lambda s: s.ssim, ".4f", "max"),
    _Column("LPIPS", lambda s: s.lpips, ".4f", "min"),
    _Column("degenerate", lambda s: s.degenerate_faces, "d", "min"),
    _Column("self-int. %", lambda s: s.self_intersecting, ".2f", "min"),
    _Column("seconds", lambda s: s.seconds, ".0f"),
)


def write_tables(rows: Sequence[dict[str, Any]], variants: Sequence[str], out: Path, command: str) -> list[Summary]:
    """Writes the four files; returns the summaries.

    Args:
        rows: of `results.rows_of`; at least one.
        variants: in the order of the columns.
        out: folder.
        command: the command line, for the record.
    """
    summaries = summarize(rows, variants)
    origin = origin_of(command)
    document = {**origin, "versions": versions_of(), "rows": list(rows), "summary": [asdict(s) for s in summaries]}
    objects = sorted({row["object"] for row in rows})
    write_text(out / "results.json", json.dumps(document, indent=2) + "\n")
    write_text(out / "results.csv", csv_text(rows))
    write_text(out / "results.md", _markdown(rows, objects, variants, summaries, origin))
    write_text(out / "results.tex", _latex(rows, objects, variants, summaries))
    return summaries


def _markdown(
    rows: Sequence[dict[str, Any]],
    objects: Sequence[str],
    variants: Sequence[str],
    summaries: Sequence[Summary],
    origin: dict[str, str],
) -> str:
    shown = [column for column in _COLUMNS if any(column.value(summary) is not None for summary in summaries)]
    lines = [
        f"`{origin['command']}`, {origin['date']}, commit {origin['commit']}, {origin['machine']}.",
        "",
        "Chamfer distances (CD) times 1000, squared and two-sided; wins: objects with the lowest. Best in bold.",
        "",
        "| variant | " + " | ".join(column.title for column in shown) + " |",
        "|---|" + "---|" * len(shown),
    ]
    lines += [
        f"| {summary.variant} | " + " | ".join(_cell(column, summary, summaries, "**") for column in shown) + " |"
        for summary in summaries
    ]
    lines += ["", "Chamfer distance by object, in brackets the paper's.", ""]
    lines += ["| object | " + " | ".join(variants) + " |", "|---|" + "---|" * len(variants)]
    for name in objects:
        values = {variant: chamfer_of(rows, name, variant) for variant in variants}
        lowest = min(value for value in values.values() if value is not None)
        cells = [_object_cell(name, variant, value, lowest, "**") for variant, value in values.items()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _latex(
    rows: Sequence[dict[str, Any]], objects: Sequence[str], variants: Sequence[str], summaries: Sequence[Summary]
) -> str:
    shown = [column for column in _COLUMNS if any(column.value(summary) is not None for summary in summaries)]
    summary_lines = [[s.variant, *(_cell(column, s, summaries, r"\textbf") for column in shown)] for s in summaries]
    object_lines = []
    for name in objects:
        values = {variant: chamfer_of(rows, name, variant) for variant in variants}
        lowest = min(value for value in values.values() if value is not None)
        object_lines.append([name, *(_object_cell(name, v, x, lowest, r"\textbf") for v, x in values.items())])
    return "\n\n".join(
        [
            "% needs booktabs",
            latex_tabular(["variant", *(column.title for column in shown)], summary_lines),
            latex_tabular(["object", *variants], object_lines) + "\n",
        ]
    )


def _cell(column: _Column, summary: Summary, summaries: Sequence[Summary], mark: str) -> str:
    value = column.value(summary)
    if value is None:
        return "-"
    present = [other for s in summaries if (other := column.value(s)) is not None]
    winner = {"min": min(present), "max": max(present)}.get(column.best or "")
    return bold(f"{value:{column.format}}", value == winner and len(summaries) > 1, mark)


def _object_cell(name: str, variant: str, value: float | None, lowest: float, mark: str) -> str:
    if value is None:
        return "-"
    printed = paper_chamfer(name, variant)
    text = bold(f"{value:.3f}", value == lowest, mark)
    return text if printed is None else f"{text} ({printed:g})"
