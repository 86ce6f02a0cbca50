"""What a grid's runs came to: rows, and what they amount to for each variant."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from studies.grid.cells import Cell
from studies.objects.paper import paper_chamfer

METRICS = (
    "chamfer",
    "chamfer_exact",
    "f_score",
    "psnr",
    "psnr_mesh",
    "ssim",
    "flip",
    "lpips",
    "degenerate_faces",
    "self_intersections",
    "faces",
    "iterations",
    "seconds",
    "threads",
)


@dataclass(frozen=True)
class Summary:
    """A variant over all objects and seeds. Chamfer distances times 1000; None where nothing was measured.

    Attributes:
        variant: its name.
        runs: how many are finished.
        chamfer: mean.
        chamfer_median: median.
        chamfer_exact: mean.
        wins: objects on which its Chamfer distance, mean over seeds, is the lowest of all variants.
        spread: standard deviation over seeds, mean over objects; None for one seed.
        f_score: mean, in percent.
        psnr: mean, dB.
        psnr_mesh: mean, dB.
        ssim: mean.
        lpips: mean.
        degenerate_faces: sum.
        self_intersecting: percent of faces, mean.
        seconds: mean.
        paper_chamfer: the paper's mean over the same objects, if it has them all.
    """

    variant: str
    runs: int
    chamfer: float | None
    chamfer_median: float | None
    chamfer_exact: float | None
    wins: int
    spread: float | None
    f_score: float | None
    psnr: float | None
    psnr_mesh: float | None
    ssim: float | None
    lpips: float | None
    degenerate_faces: int
    self_intersecting: float | None
    seconds: float | None
    paper_chamfer: float | None


def rows_of(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """One row for each finished run."""
    rows = []
    for cell in cells:
        if cell.state == "done":
            metrics = cell.metrics()
            row = {"object": cell.object, "variant": cell.variant, "seed": cell.seed}
            row |= {name: metrics.get(name) for name in METRICS}
            rows.append(row | {"paper_chamfer": paper_chamfer(cell.object, cell.variant)})
    return rows


def chamfer_of(rows: Sequence[dict[str, Any]], name: str, variant: str) -> float | None:
    """Chamfer distance of an object and variant times 1000, mean over seeds."""
    values = [1e3 * row["chamfer"] for row in rows if row["object"] == name and row["variant"] == variant]
    return statistics.fmean(values) if values else None


def summarize(rows: Sequence[dict[str, Any]], variants: Sequence[str]) -> list[Summary]:
    """A summary for each variant, in the order given."""
    objects = sorted({row["object"] for row in rows})
    best: dict[str, str] = {}
    for name in objects:
        distances = {variant: chamfer_of(rows, name, variant) for variant in variants}
        present = {variant: value for variant, value in distances.items() if value is not None}
        best[name] = min(present, key=lambda variant: present[variant])
    return [_summary([row for row in rows if row["variant"] == name], name, best) for name in variants]


def _summary(rows: list[dict[str, Any]], variant: str, best: dict[str, str]) -> Summary:
    def mean(name: str, scale: float = 1.0) -> float | None:
        values = [scale * row[name] for row in rows if row[name] is not None]
        return statistics.fmean(values) if values else None

    objects = sorted({row["object"] for row in rows})
    per_object = [value for name in objects if (value := chamfer_of(rows, name, variant)) is not None]
    deviations = []
    for name in objects:
        values = [1e3 * row["chamfer"] for row in rows if row["object"] == name]
        if len(values) > 1:
            deviations.append(statistics.stdev(values))
    printed = [paper_chamfer(name, variant) for name in objects]
    return Summary(
        variant=variant,
        runs=len(rows),
        chamfer=statistics.fmean(per_object) if per_object else None,
        chamfer_median=statistics.median(per_object) if per_object else None,
        chamfer_exact=mean("chamfer_exact", 1e3),
        wins=sum(winner == variant for winner in best.values()),
        spread=statistics.fmean(deviations) if deviations else None,
        f_score=mean("f_score", 100.0),
        psnr=mean("psnr"),
        psnr_mesh=mean("psnr_mesh"),
        ssim=mean("ssim"),
        lpips=mean("lpips"),
        degenerate_faces=sum(row["degenerate_faces"] for row in rows),
        self_intersecting=(
            statistics.fmean(100.0 * row["self_intersections"] / row["faces"] for row in rows) if rows else None
        ),
        seconds=mean("seconds"),
        paper_chamfer=(
            statistics.fmean(value for value in printed if value is not None)
            if printed and None not in printed
            else None
        ),
    )
