"""How good reconstructions are: a row for each run and for each hull, and what they amount to, at worst too."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from etsplat.geometry.intersections import count_self_intersections
from etsplat.geometry.parts import Shape, shape_of
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.metrics.geometry import geometry_metrics
from etsplat.tasks.judgement import true_shape
from studies.grid.cells import Cell
from studies.objects.hulls import Hull
from studies.objects.subjects import Subject

HULL = "hull alone"
"""What stands in the place of a variant for it."""


@dataclass(frozen=True)
class Row:
    """One result. Numbers are as in metrics.json; None where something was not measured.

    Attributes:
        object: name of the object.
        variant: of the run, or `HULL`.
        seed: of the run; None for a hull.
        mesh: file of the result, in the units of the source.
        chamfer: squared, two-sided.
        chamfer_exact: the same to the surface itself.
        silhouette_iou: mean over the test views.
        psnr_mesh: of the opaque mesh on the test views, dB.
        self_intersecting: faces that cut through others, in percent.
        parts: of the result; None, as `holes`, where it is no closed manifold.
        holes: of the result.
        true_parts: of the true surface; None, as `true_holes`, where it is not known, or has none that are clear.
        true_holes: of the true surface.
        right: whether parts and holes are the true ones; None where these are not known.
        seconds: that it took.
        verdict: of the run, which begins with "good" or "poor".
    """

    object: str
    variant: str
    seed: int | None
    mesh: str
    chamfer: float | None
    chamfer_exact: float | None
    silhouette_iou: float | None
    psnr_mesh: float | None
    self_intersecting: float
    parts: int | None
    holes: int | None
    true_parts: int | None
    true_holes: int | None
    right: bool | None
    seconds: float
    verdict: str | None

    @property
    def good(self) -> bool | None:
        """What the verdict begins with; None without one."""
        return None if self.verdict is None else self.verdict.startswith("good")


@dataclass(frozen=True)
class Measure:
    """A number of a row: its title, its name, a factor, a format, and whether large ones are bad."""

    title: str
    key: str
    factor: float
    form: str
    large_is_bad: bool

    def of(self, row: Row) -> float | None:
        """Times the factor."""
        value = getattr(row, self.key)
        return None if value is None else self.factor * value


MEASURES = (
    Measure("CD", "chamfer", 1e3, ".3f", True),
    Measure("exact CD", "chamfer_exact", 1e3, ".3f", True),
    Measure("silhouette IoU", "silhouette_iou", 1.0, ".4f", False),
    Measure("PSNR of mesh", "psnr_mesh", 1.0, ".2f", False),
    Measure("self-int. %", "self_intersecting", 1.0, ".2f", True),
    Measure("seconds", "seconds", 1.0, ".0f", True),
)


@dataclass(frozen=True)
class Amount:
    """What a measure comes to.

    Attributes:
        mean: over the objects, of the means over seeds.
        worst: of all runs.
        object: that has the worst.
        spread: standard deviation over seeds, mean over objects; None for one seed.
    """

    mean: float
    worst: float
    object: str
    spread: float | None


@dataclass(frozen=True)
class Summary:
    """A variant over all objects and seeds.

    Attributes:
        variant: its name.
        runs: how many there are.
        amounts: by the key of the measure, times its factor; None where it was never measured.
        right: runs with the parts and holes of the true surface, of `compared`.
        compared: runs whose true surface has clear ones.
        good: runs that were judged good, of `judged`.
        judged: runs that were judged.
    """

    variant: str
    runs: int
    amounts: dict[str, Amount | None]
    right: int
    compared: int
    good: int
    judged: int


def row_of_run(cell: Cell, surface: MeshFile | None, true: Shape, samples: int) -> Row:
    """A finished run. What its own metrics lack is measured against the true surface of a capture.

    Args:
        cell: of a reconstruction.
        surface: the true one, in the units of the source.
        true: its parts and holes.
        samples: points on each surface for the Chamfer distance.
    """
    metrics, path = cell.metrics(), RunDirectory(cell.folder).mesh_path(".ply")
    distances = metrics["chamfer"], metrics["chamfer_exact"]
    if None in distances and surface is not None:
        distances = _distances(load_mesh(path), surface, samples)
    judgement = metrics["judgement"]
    found = Shape(judgement["parts"], judgement["holes"])
    return Row(
        object=cell.object,
        variant=cell.variant,
        seed=cell.seed,
        mesh=str(path),
        chamfer=distances[0],
        chamfer_exact=distances[1],
        silhouette_iou=metrics["silhouette_iou"],
        psnr_mesh=metrics["psnr_mesh"],
        self_intersecting=100 * metrics["self_intersections"] / metrics["faces"],
        parts=found.parts,
        holes=found.holes,
        true_parts=true.parts,
        true_holes=true.holes,
        right=_right(found, true),
        seconds=metrics["seconds"],
        verdict=judgement["verdict"],
    )


def row_of_hull(subject: Subject, hull: Hull, path: Path, surface: MeshFile | None, true: Shape, samples: int) -> Row:
    """A hull, whose mesh is at `path`; the rest as for a run."""
    mesh = load_mesh(path)
    distances = (None, None) if surface is None else _distances(mesh, surface, samples)
    found = shape_of(mesh.vertices, mesh.faces)
    return Row(
        object=subject.name,
        variant=HULL,
        seed=None,
        mesh=str(path),
        chamfer=distances[0],
        chamfer_exact=distances[1],
        silhouette_iou=hull.silhouette_iou,
        psnr_mesh=None,
        self_intersecting=100 * count_self_intersections(mesh.vertices, mesh.faces) / len(mesh.faces),
        parts=found.parts,
        holes=found.holes,
        true_parts=true.parts,
        true_holes=true.holes,
        right=_right(found, true),
        seconds=hull.seconds,
        verdict=None,
    )


def rows_of_subject(subject: Subject, cells: Sequence[Cell], hull: Hull, samples: int) -> list[Row]:
    """The finished runs of an object and its hull."""
    surface = None if subject.surface is None else load_mesh(subject.surface)
    true = Shape(None, None, "is not known") if surface is None else true_shape(surface)
    done = [cell for cell in cells if cell.object == subject.name and cell.state == "done"]
    rows = [row_of_run(cell, surface, true, samples) for cell in done]
    if hull.mesh is not None:
        rows.append(row_of_hull(subject, hull, hull.mesh, surface, true, samples))
    return rows


def badness(row: Row) -> tuple[bool, float, float]:
    """Larger is worse: the Chamfer distance decides; without one the silhouettes do, and it comes behind all others."""
    return row.chamfer is not None, row.chamfer or 0.0, -1.0 if row.silhouette_iou is None else -row.silhouette_iou


def worst_first(rows: Sequence[Row]) -> list[str]:
    """The objects with runs, by the worst run of each."""
    worst: dict[str, tuple[bool, float, float]] = {}
    for row in rows:
        if row.variant != HULL:
            worst[row.object] = max(badness(row), worst.get(row.object, badness(row)))
    return sorted(worst, key=lambda name: worst[name], reverse=True)


def summarize(rows: Sequence[Row]) -> list[Summary]:
    """One for each variant, in the order of the rows."""
    summaries = []
    for variant in dict.fromkeys(row.variant for row in rows):
        own = [row for row in rows if row.variant == variant]
        compared = [row.right for row in own if row.right is not None]
        judged = [row.good for row in own if row.good is not None]
        amounts = {measure.key: _amount(own, measure) for measure in MEASURES}
        summaries.append(Summary(variant, len(own), amounts, sum(compared), len(compared), sum(judged), len(judged)))
    return summaries


def _amount(rows: Sequence[Row], measure: Measure) -> Amount | None:
    values: dict[str, list[float]] = {}
    for row in rows:
        if (value := measure.of(row)) is not None:
            values.setdefault(row.object, []).append(value)
    if not values:
        return None
    extreme: Callable[[Sequence[float]], float] = max if measure.large_is_bad else min
    worst = {name: extreme(found) for name, found in values.items()}
    name = next(name for name, value in worst.items() if value == extreme(list(worst.values())))
    spreads = [statistics.stdev(found) for found in values.values() if len(found) > 1]
    return Amount(
        mean=statistics.fmean(statistics.fmean(found) for found in values.values()),
        worst=worst[name],
        object=name,
        spread=statistics.fmean(spreads) if spreads else None,
    )


def _right(found: Shape, true: Shape) -> bool | None:
    return None if true.parts is None else (found.parts, found.holes) == (true.parts, true.holes)


def _distances(mesh: MeshFile, surface: MeshFile, samples: int) -> tuple[float, float]:
    found = geometry_metrics(mesh.vertices, mesh.faces, surface.vertices, surface.faces, samples=samples)
    return found.chamfer, found.chamfer_exact
