"""Tables nvs, per-scene, filter and efficiency as CSV, JSON, Markdown and LaTeX."""

import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from studies.grid.writing import bold, csv_text, latex_tabular, origin_of, versions_of, write_text
from studies.scenes.cells import CULLED
from studies.scenes.paper import NVS, PER_SCENE, SCENES


@dataclass(frozen=True)
class Table:
    """Numbers with titles.

    Attributes:
        name: of the table.
        note: a sentence about it.
        columns: title, format, and whether the largest (+1), the smallest (-1) or none (0) is best.
        rows: title and values; None where nothing was measured.
    """

    name: str
    note: str
    columns: list[tuple[str, str, int]]
    rows: list[tuple[str, list[float | None]]]

    def cells(self, mark: str) -> list[list[str]]:
        """Rows of text, the best value of each column set in bold where there are several."""
        lines = [[title] for title, _ in self.rows]
        for index, (_, form, best) in enumerate(self.columns):
            values = [row[index] for _, row in self.rows]
            present = [value for value in values if value is not None]
            winner = {1: max, -1: min}[best](present) if best and len(present) > 1 else None
            for line, value in zip(lines, values, strict=True):
                line.append("-" if value is None else bold(f"{value:{form}}", value == winner, mark))
        return lines


_QUALITY = (("PSNR", "psnr", ".2f", 1), ("SSIM", "ssim", ".4f", 1), ("LPIPS", "lpips_3dgs", ".4f", -1))


def write_nvs_tables(rows: Sequence[dict[str, Any]], out: Path, command: str) -> list[Table]:
    """Writes nvs.csv, nvs.json, nvs.md and nvs.tex; returns the tables.

    Args:
        rows: of `evaluate_cells`; at least one.
        out: folder.
        command: the command line, for the record.
    """
    tables = nvs_tables(rows)
    origin = origin_of(command)
    document = {**origin, "versions": versions_of(), "rows": list(rows)}
    write_text(out / "nvs.json", json.dumps(document, indent=2) + "\n")
    write_text(out / "nvs.csv", csv_text(rows))
    write_text(out / "nvs.md", _markdown(tables, origin))
    parts = [latex_tabular(_head(table), table.cells(r"\textbf")) for table in tables]
    write_text(out / "nvs.tex", "\n\n".join(["% needs booktabs", *parts]) + "\n")
    return tables


def nvs_tables(rows: Sequence[dict[str, Any]]) -> list[Table]:
    """The tables of a grid. Means are taken over the scenes that every variant has finished, so that they compare."""
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    scenes = [
        scene
        for scene in dict.fromkeys(row["scene"] for row in rows)
        if {row["variant"] for row in rows if row["scene"] == scene} == set(variants)
    ]

    def mean(variant: str, key: str, among: Sequence[str]) -> float | None:
        values = [row[key] for row in rows if row["variant"] == variant and row["scene"] in among]
        present = [value for value in values if value is not None]
        return statistics.fmean(present) if present and len(present) == len(values) else None

    tables = [_overall(variants, scenes, mean, _seeds_of(rows))]
    everything = list(dict.fromkeys(row["scene"] for row in rows))
    for index, (title, key, form, best) in enumerate(_QUALITY):
        if any(row[key] is not None for row in rows):
            body = []
            for variant in variants:
                body.append((variant, [mean(variant, key, [scene]) for scene in everything]))
                body += _printed_per_scene(variant, everything, index)
            tables.append(Table(f"per-scene {title}", "", [(scene, form, best) for scene in everything], body))
            if _seeds_of(rows):
                tables.append(_spread(rows, title, key, form))
    if any(variant.endswith(CULLED) for variant in variants) and not all(v.endswith(CULLED) for v in variants):
        tables.append(_filter(variants, scenes, mean))
    columns = [("minutes", ".1f", -1), ("primitives", ",.0f", 0), ("frames/s", ".1f", 1), ("ms per million", ".1f", -1)]
    keys = ("minutes", "triangles", "fps", "ms_per_million")
    body = [(variant, [mean(variant, key, scenes) for key in keys]) for variant in variants]
    tables.append(Table("efficiency", "Colour only, test views one after the other.", columns, body))
    return tables


_Mean = Callable[[str, str, Sequence[str]], float | None]


def _overall(variants: Sequence[str], scenes: Sequence[str], mean: _Mean, seeds: str) -> Table:
    """Table nvs, with the paper's row where a data set is complete."""
    columns = [(title, form, best) for title, _, form, best in _QUALITY] + [("PSNR opaque", ".2f", 1)]
    keys = [key for _, key, _, _ in _QUALITY] + ["psnr_opaque"]
    body: list[tuple[str, list[float | None]]] = []
    for variant in variants:
        body.append((variant, [mean(variant, key, scenes) for key in keys]))
        printed = _printed(variant, scenes)
        if printed is not None:
            body.append((f"{variant} (paper)", [*printed, None]))
    note = f"Means over {', '.join(scenes)}{seeds}. LPIPS in the convention of 3DGS."
    return Table("nvs", note, columns, body)


def _seeds_of(rows: Sequence[dict[str, Any]]) -> str:
    """How many seeds the means are over, if there are several."""
    count = len({row["seed"] for row in rows})
    return f" and {count} seeds" if count > 1 else ""


def _spread(rows: Sequence[dict[str, Any]], title: str, key: str, form: str) -> Table:
    """What another seed changes: standard deviations of a measure, over the seeds that were run."""
    variants, scenes = (list(dict.fromkeys(row[name] for row in rows)) for name in ("variant", "scene"))

    def deviation(variant: str, scene: str) -> float | None:
        values = [row[key] for row in rows if (row["variant"], row["scene"]) == (variant, scene)]
        return statistics.stdev(values) if len(values) > 1 and None not in values else None

    body = [(variant, [deviation(variant, scene) for scene in scenes]) for variant in variants]
    note = "Standard deviation from seed to seed."
    return Table(f"per-scene {title}, spread", note, [(scene, form, 0) for scene in scenes], body)


def _printed(variant: str, scenes: Sequence[str]) -> tuple[float, float, float] | None:
    method = variant.removesuffix(f" {CULLED}")
    for dataset in dict.fromkeys(scene.dataset for scene in SCENES.values()):
        if set(scenes) == {name for name, scene in SCENES.items() if scene.dataset == dataset}:
            return NVS.get((method, dataset))
    return None


def _printed_per_scene(variant: str, scenes: Sequence[str], index: int) -> list[tuple[str, list[float | None]]]:
    """The paper's row of a per-scene table, if the paper has any of the scenes; `index` is that of the metric."""
    printed = PER_SCENE.get(variant.removesuffix(f" {CULLED}"), {})
    values = [printed[scene][index] if scene in printed else None for scene in scenes]
    return [] if all(value is None for value in values) else [(f"{variant} (paper)", values)]


def _filter(variants: Sequence[str], scenes: Sequence[str], mean: _Mean) -> Table:
    """Table filter: each method without and with culling of small triangles, and the difference."""
    columns = [(title, form, 0) for title, _, form, _ in _QUALITY]
    body: list[tuple[str, list[float | None]]] = []
    for variant in variants:
        culled = f"{variant} {CULLED}"
        if variant.endswith(CULLED) or culled not in variants:
            continue
        kept, cut = ([mean(name, key, scenes) for _, key, _, _ in _QUALITY] for name in (variant, culled))
        gain = [None if a is None or b is None else a - b for a, b in zip(kept, cut, strict=True)]
        body += [(f"{variant}, culled", cut), (f"{variant}, kept", kept), (f"{variant}, kept - culled", gain)]
    return Table("filter", "Whether triangles with an inradius below one pixel are culled.", columns, body)


def _head(table: Table) -> list[str]:
    return ["", *(title for title, _, _ in table.columns)]


def _markdown(tables: Sequence[Table], origin: dict[str, str]) -> str:
    lines = [f"`{origin['command']}`, {origin['date']}, commit {origin['commit']}, {origin['machine']}.", ""]
    for table in tables:
        lines += [f"**{table.name}.** {table.note}".rstrip(), "", "| " + " | ".join(_head(table)) + " |"]
        lines += ["|---|" + "---:|" * len(table.columns)]
        lines += ["| " + " | ".join(line) + " |" for line in table.cells("**")] + [""]
    return "\n".join(lines)
