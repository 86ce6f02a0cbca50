"""The numbers of a sweep: a row for each run, means over seeds, as CSV and JSON."""

import csv
import io
import json
import platform
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from etsplat.io.atomic import atomic_write
from etsplat.tasks.sweeps.cells import Cell
from etsplat.tasks.sweeps.sweep import short_names, shown


@dataclass(frozen=True)
class Measure:
    """A number of metrics.json as tables have it: its title, key, factor and format, and which way is better.

    `better` is 1 where more is, -1 where less is, and 0 where neither is.
    """

    title: str
    key: str
    factor: float
    form: str
    better: int

    def text(self, value: float | None) -> str:
        """A value as it is shown; a dash if it was not measured."""
        return "-" if value is None else f"{self.factor * value:{self.form}}"


_PSNR = Measure("PSNR, dB", "psnr", 1.0, ".2f", 1)
_COMMON = (
    Measure("SSIM", "ssim", 1.0, ".4f", 1),
    Measure("FLIP", "flip", 1.0, ".4f", -1),
)
_SECONDS = Measure("seconds", "seconds", 1.0, ".0f", 0)

MEASURES: Mapping[str, tuple[Measure, ...]] = {
    "reconstruct": (
        Measure("Chamfer × 1000", "chamfer", 1000.0, ".3f", -1),
        _PSNR,
        Measure("silhouette IoU, %", "silhouette_iou", 100.0, ".2f", 1),
        *_COMMON,
        Measure("faces", "faces", 1.0, ",.0f", 0),
        _SECONDS,
    ),
    "train": (
        _PSNR,
        *_COMMON,
        Measure("PSNR opaque, dB", "psnr_opaque", 1.0, ".2f", 1),
        Measure("triangles", "triangles", 1.0, ",.0f", 0),
        _SECONDS,
    ),
}
"""By task, the most telling first."""


@dataclass(frozen=True)
class Row:
    """A run of a sweep that is done.

    Attributes:
        input: its name.
        chosen: the settings of its combination, by dotted name.
        seed: of the run.
        metrics: of metrics.json.
        folder: run directory.
    """

    input: str
    chosen: Mapping[str, Any]
    seed: int
    metrics: Mapping[str, Any]
    folder: Path


@dataclass(frozen=True)
class Line:
    """A combination on an input: what its runs come to.

    Attributes:
        input: its name.
        chosen: the combination.
        rows: its runs, by seed.
    """

    input: str
    chosen: Mapping[str, Any]
    rows: tuple[Row, ...]

    def values(self, measure: Measure) -> list[float]:
        """Of all runs that have it."""
        return [row.metrics[measure.key] for row in self.rows if row.metrics.get(measure.key) is not None]

    def mean(self, measure: Measure) -> float | None:
        """Over the seeds; None if none was measured."""
        values = self.values(measure)
        return statistics.fmean(values) if values else None

    def text(self, measure: Measure) -> str:
        """The mean, and after ± the standard deviation over seeds where there are several."""
        values = self.values(measure)
        if len(values) < 2 or measure.better == 0:
            return measure.text(self.mean(measure))
        return f"{measure.text(self.mean(measure))} ± {measure.text(statistics.stdev(values))}"


@dataclass(frozen=True)
class Found:
    """What a sweep came to.

    Attributes:
        command: the command line that repeats it.
        varied: settings that have several values.
        lines: by input, in the order of the combinations.
        failed: runs that failed.
        total: how many runs it has.
        measures: those that any run has.
        kind: "sweep" or "search"; its files are named so.
        asked: key of the measure that lines are ordered by; None for the first that all runs have.
    """

    command: str
    varied: list[str]
    lines: list[Line]
    failed: list[Cell]
    total: int
    measures: list[Measure]
    kind: str = "sweep"
    asked: str | None = None

    @property
    def rows(self) -> list[Row]:
        """All runs that are done."""
        return [row for line in self.lines for row in line.rows]

    @property
    def goal(self) -> Measure:
        """What lines are ordered by."""
        for measure in self.measures:
            if measure.key == self.asked:
                return measure
        whole = [
            m for m in self.measures if m.better and all(len(line.values(m)) == len(line.rows) for line in self.lines)
        ]
        return (whole or self.measures)[0]

    @property
    def failures(self) -> list[tuple[str, Path]]:
        """Of each run that failed which it is and why, and its log."""
        return [(f"{c.object}, {c.variant}, seed {c.seed}: failed: {c.error}", c.log) for c in self.failed]

    def best(self, name: str, measure: Measure) -> Line | None:
        """The line of an input that is best by a measure; None if there is none, or nothing between them."""
        lines = [line for line in self.lines if line.input == name and line.values(measure)]
        if len({line.mean(measure) for line in lines}) < 2 or not measure.better:
            return None
        return max(lines, key=lambda line: measure.better * (line.mean(measure) or 0.0))

    @property
    def inputs(self) -> list[str]:
        """Names of the inputs that have a line."""
        return list(dict.fromkeys(line.input for line in self.lines))


def gather(
    cells: Sequence[Cell],
    chosen: Mapping[str, Mapping[str, Any]],
    task: str,
    command: str,
    kind: str = "sweep",
    asked: str | None = None,
) -> Found:
    """What the runs came to.

    Args:
        cells: of the sweep.
        chosen: its combinations, by the variant's name.
        task: of all runs.
        command: the command line.
        kind: "sweep" or "search".
        asked: key of the measure that matters; None for the first that all runs have.
    """
    lines: dict[tuple[str, str], list[Row]] = {}
    for cell in cells:
        if cell.state == "done":
            row = Row(cell.object, chosen[cell.variant], cell.seed, cell.metrics(), cell.folder)
            lines.setdefault((cell.object, cell.variant), []).append(row)
    made = [Line(name, chosen[variant], tuple(rows)) for (name, variant), rows in lines.items()]
    measures = [m for m in MEASURES[task] if any(line.values(m) for line in made)]
    varied = [key for key in next(iter(chosen.values())) if len({repr(one[key]) for one in chosen.values()}) > 1]
    failed = [cell for cell in cells if cell.state == "failed"]
    return Found(command, varied, made, failed, len(cells), measures, kind, asked)


def write_rows(found: Found, out: Path) -> None:
    """Writes KIND.csv, a row for each run with the measures of the table, and KIND.json with all metrics.

    Raises:
        InputError: the folder cannot be written to.
    """
    names = list(found.rows[0].chosen)
    table = [
        {"input": row.input, **row.chosen, "seed": row.seed, **{m.key: row.metrics.get(m.key) for m in found.measures}}
        for row in found.rows
    ]
    text = io.StringIO()
    keys = ["input", *names, "seed", *(measure.key for measure in found.measures)]
    writer = csv.DictWriter(text, keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    document = {
        "command": found.command,
        "date": date.today().isoformat(),
        "versions": {name: version(name) for name in ("etsplat", "torch")} | {"python": platform.python_version()},
        "runs": [
            {
                "input": row.input,
                "settings": dict(row.chosen),
                "seed": row.seed,
                "folder": str(row.folder.relative_to(out)),
                "metrics": dict(row.metrics),
            }
            for row in found.rows
        ],
        "failed": [
            {
                "input": cell.object,
                "settings": cell.variant,
                "seed": cell.seed,
                "error": cell.error,
                "log": str(cell.log),
            }
            for cell in found.failed
        ],
    }
    for name, content in (
        (f"{found.kind}.csv", text.getvalue()),
        (f"{found.kind}.json", json.dumps(document, indent=2, default=str) + "\n"),
    ):
        with atomic_write(out / name) as temporary:
            temporary.write_text(content, encoding="utf-8")


def setting_text(found: Found, line: Line) -> str:
    """What a combination is: the settings that vary, for readers."""
    names = short_names(found.varied)
    return ", ".join(f"{names[name]}={shown(line.chosen[name])}" for name in found.varied)


def summary(found: Found) -> str:
    """In a sentence for each input: which combination is best."""
    said = []
    for name in found.inputs:
        best = found.best(name, found.goal)
        if best is not None:
            said.append(f"{name}: best with {setting_text(found, best)} ({found.goal.title} {best.text(found.goal)}).")
    return " ".join(said)
