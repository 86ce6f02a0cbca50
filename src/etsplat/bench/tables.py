"""A grid's results as files: results.csv, results.json, results.md, results.tex."""

import csv
import io
import json
import platform
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from etsplat.bench.paper import paper_chamfer
from etsplat.bench.results import Summary, chamfer_of, summarize
from etsplat.io.atomic import atomic_write


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
    origin = {"command": command, "commit": _commit(), "machine": _machine(), "date": date.today().isoformat()}
    document = {**origin, "versions": _versions(), "rows": list(rows), "summary": [asdict(s) for s in summaries]}
    objects = sorted({row["object"] for row in rows})
    _write(out / "results.json", json.dumps(document, indent=2) + "\n")
    _write(out / "results.csv", _csv(rows))
    _write(out / "results.md", _markdown(rows, objects, variants, summaries, origin))
    _write(out / "results.tex", _latex(rows, objects, variants, summaries))
    return summaries


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


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
    def tabular(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
        lines = [" & ".join(_escape(cell) for cell in line) + r" \\" for line in body]
        return "\n".join(
            [
                rf"\begin{{tabular}}{{l{'c' * (len(head) - 1)}}}",
                r"\toprule",
                " & ".join(_escape(cell) for cell in head) + r" \\",
                r"\midrule",
                *lines,
                r"\bottomrule",
                r"\end{tabular}",
            ]
        )

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
            tabular(["variant", *(column.title for column in shown)], summary_lines),
            tabular(["object", *variants], object_lines) + "\n",
        ]
    )


def _cell(column: _Column, summary: Summary, summaries: Sequence[Summary], bold: str) -> str:
    value = column.value(summary)
    if value is None:
        return "-"
    present = [other for s in summaries if (other := column.value(s)) is not None]
    winner = {"min": min(present), "max": max(present)}.get(column.best or "")
    return _bold(f"{value:{column.format}}", value == winner and len(summaries) > 1, bold)


def _object_cell(name: str, variant: str, value: float | None, lowest: float, bold: str) -> str:
    if value is None:
        return "-"
    printed = paper_chamfer(name, variant)
    text = _bold(f"{value:.3f}", value == lowest, bold)
    return text if printed is None else f"{text} ({printed:g})"


def _bold(text: str, winner: bool, bold: str) -> str:
    if not winner:
        return text
    return f"**{text}**" if bold == "**" else rf"\textbf{{{text}}}"


def _escape(text: str) -> str:
    return text.replace("_", r"\_").replace("%", r"\%").replace("±", r"$\pm$")


def _commit() -> str:
    """Of the source tree that this package runs from, or its version if it is installed."""
    try:
        found = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return f"of etsplat {version('etsplat')}"
    return found.stdout.strip()


def _machine() -> str:
    return f"{_cores()} cores, {platform.machine()}"


def _cores() -> int:
    import os

    return len(os.sched_getaffinity(0))


def _versions() -> dict[str, str]:
    return {"etsplat": version("etsplat"), "torch": version("torch"), "python": platform.python_version()}


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
