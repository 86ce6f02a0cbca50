"""One page about the quality of reconstructions: tables, and pictures of every object beside the truth."""

import base64
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from string import Template

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from etsplat.geometry.measures import bounding_ball
from etsplat.geometry.similarity import rotation_between
from etsplat.io.images import load_image, to_8_bit
from etsplat.io.mesh_files import load_mesh
from etsplat.io.overview import find_test_views
from etsplat.report.scene import own_asset
from etsplat.web.pages import asset
from studies.grid.cells import Cell
from studies.grid.writing import origin_of, versions_of, write_text
from studies.objects.hulls import Hull
from studies.objects.pictures import draw_shape
from studies.objects.quality import HULL, MEASURES, Row, Summary, badness, summarize, worst_first
from studies.objects.subjects import Subject

_TEMPLATE = Path(__file__).parent / "gallery.html"

_QUALITY = 88
"""Of the JPEG pictures."""

_ABOUT = (
    "Chamfer distances (CD) times 1000, squared and two-sided, against the known surface in its normalised frame; "
    "silhouette IoU and PSNR of the opaque mesh are means over test views. Parts and holes are right where they are "
    "those of the known surface. The mean is over objects, of the means over seeds; the worst is that of all runs; "
    "± is the standard deviation over seeds, mean over objects."
)
_ORDER = (
    "The order is that of the largest Chamfer distance; objects without a known surface come after all others, the "
    "lowest silhouette IoU first."
)

Table = tuple[list[str], list[list[str]]]
"""Head and lines, of plain text."""


@dataclass(frozen=True)
class Shown:
    """An object of the page.

    Attributes:
        subject: what it is.
        hull: of its photos.
        rows: its runs and its hull.
    """

    subject: Subject
    hull: Hull
    rows: list[Row]


def write_gallery(shown: Sequence[Shown], failed: Sequence[Cell], out: Path, command: str) -> None:
    """Writes results.md, results.json and gallery.html.

    Args:
        shown: objects with at least one run.
        failed: runs that failed.
        out: folder.
        command: the command line, for the record.
    """
    by_name = {each.subject.name: each for each in shown}
    order = worst_first([row for each in shown for row in each.rows])
    rows = [row for name in order for row in by_name[name].rows]
    summaries, origin = summarize(rows), origin_of(command)
    document = {**origin, "versions": versions_of(), "rows": [asdict(row) for row in rows]}
    document["summary"] = [asdict(summary) for summary in summaries]
    write_text(out / "results.json", json.dumps(document, indent=2) + "\n")
    summary, runs = summary_table(summaries), runs_table(rows)
    told = f"{origin['date']}, commit {origin['commit']}, {origin['machine']}."
    lines = [f"`{command}`, {told}", _ABOUT, _markdown(summary), f"Every run, worst objects first. {_ORDER}"]
    lines += [_markdown(runs), *(f"- {line}" for line in _failures(failed))]
    write_text(out / "results.md", "\n\n".join(lines) + "\n")
    page = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title="Reconstructed objects",
        style="\n".join([asset("base.css"), own_asset("page.css")]),
        origin=f"<code>{escape(command)}</code>, {escape(told)}",
        about=escape(_ABOUT),
        order=escape(_ORDER),
        summary=_html(summary),
        objects="".join(_section(by_name[name]) for name in order),
        rows=_html(runs),
        failed="".join(f'<p class="verdict poor">{escape(line)}</p>' for line in _failures(failed)),
    )
    write_text(out / "gallery.html", page)


def summary_table(summaries: Sequence[Summary]) -> Table:
    """For each variant the mean of every measure, the worst with its object, and the spread over seeds."""
    lines = []
    for summary in summaries:
        mean, worst, spread = [summary.variant, "mean"], ["", "worst"], ["", "± seeds"]
        for measure in MEASURES:
            amount = summary.amounts[measure.key]
            mean.append("-" if amount is None else f"{amount.mean:{measure.form}}")
            worst.append("-" if amount is None else f"{amount.worst:{measure.form}} ({amount.object})")
            spread.append("-" if amount is None or amount.spread is None else f"{amount.spread:{measure.form}}")
        mean += [_share(summary.right, summary.compared), _share(summary.good, summary.judged)]
        lines += [line + [""] * (len(mean) - len(line)) for line in (mean, worst, spread)]
    return ["variant", "", *(measure.title for measure in MEASURES), "parts and holes right", "judged good"], lines


def runs_table(rows: Sequence[Row]) -> Table:
    """A line for each run and hull."""
    lines = []
    for row in rows:
        values = [measure.of(row) for measure in MEASURES]
        texts = ["-" if v is None else f"{v:{m.form}}" for v, m in zip(values, MEASURES, strict=True)]
        seed, verdict = "-" if row.seed is None else str(row.seed), {True: "good", False: "poor", None: "-"}[row.good]
        lines.append([row.object, row.variant, seed, *texts, _topology(row), verdict])
    return ["object", "variant", "seed", *(measure.title for measure in MEASURES), "parts, holes", "verdict"], lines


def _share(count: int, total: int) -> str:
    return "-" if total == 0 else f"{count} of {total}"


def _topology(row: Row) -> str:
    found = "unclear" if row.parts is None else f"{row.parts}, {row.holes}"
    if row.right is None:
        return found
    return f"{found}: right" if row.right else f"{found}: wrong, not {row.true_parts}, {row.true_holes}"


def _failures(cells: Sequence[Cell]) -> list[str]:
    return [f"{cell.object}, {cell.variant}, seed {cell.seed}: failed: {cell.error}" for cell in cells]


def _markdown(table: Table) -> str:
    head, lines = table
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *lines))


def _html(table: Table) -> str:
    head, lines = table
    first = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in line) + "</tr>" for line in lines)
    return f'<div class="card wide"><table><tr>{first}</tr>{body}</table></div>'


def _section(shown: Shown) -> str:
    """An object: its pictures, and what was said of the runs that they show."""
    runs = [row for row in shown.rows if row.variant != HULL]
    variants = dict.fromkeys(row.variant for row in runs)
    worst = [max((row for row in runs if row.variant == variant), key=badness) for variant in variants]
    place = _Placement(shown, worst[0])
    figures = [place.truth()]
    for row in worst:
        title = f"{row.variant}, seed {row.seed}"
        figures += [place.drawn(Path(row.mesh), title), place.drawn(Path(row.mesh), f"{title}: normals", normals=True)]
    if shown.hull.mesh is not None:
        figures.append(place.drawn(shown.hull.mesh, HULL))
    else:
        figures.append(f'<p class="note">No hull: {escape(shown.hull.problem or "")}</p>')
    verdicts = "".join(
        f'<p class="verdict {"good" if row.good else "poor"}">{escape(f"{row.variant}: {row.verdict}")}</p>'
        for row in worst
    )
    name = escape(shown.subject.name)
    return (
        f'<section class="object"><h3>{name}</h3>{verdicts}<div class="pictures">{"".join(figures)}</div>'
        f"{_html(runs_table(shown.rows))}</section>\n"
    )


class _Placement:
    """Brings all surfaces of an object into the frame in which they are drawn: that of the truth, upright."""

    def __init__(self, shown: Shown, run: Row) -> None:
        self._shown, self._run = shown, run
        surface = load_mesh(shown.subject.surface or run.mesh)
        self._center, self._radius = bounding_ball(surface.vertices)
        up = shown.hull.up
        self._turn = (
            torch.eye(3).double()
            if up is None
            else rotation_between(torch.tensor(up, dtype=torch.float64), torch.eye(3)[1])
        )

    def drawn(self, path: Path, title: str, *, normals: bool = False) -> str:
        """A figure of a surface."""
        mesh = load_mesh(path)
        vertices = (mesh.vertices.double() - self._center) / self._radius @ self._turn.T
        return _figure(draw_shape(vertices.float(), mesh.faces, normals=normals), title)

    def truth(self) -> str:
        """A figure of the true surface; of a test photo where it is not known."""
        if self._shown.subject.surface is not None:
            return self.drawn(self._shown.subject.surface, "truth")
        photos = find_test_views(Path(self._run.mesh).parent / "test", "mesh")
        if not photos:
            return '<p class="note">Neither a known surface nor a test photo.</p>'
        return _figure(load_image(photos[0].truth)[..., :3], "a test photo")


def _figure(picture: Float[Tensor, "H W 3"], title: str) -> str:
    buffer = io.BytesIO()
    Image.fromarray(to_8_bit(picture).numpy()).save(buffer, "JPEG", quality=_QUALITY)
    content = base64.b64encode(buffer.getvalue()).decode("ascii")
    return (
        f'<figure class="card"><img src="data:image/jpeg;base64,{content}" alt="{escape(title)}">'
        f"<figcaption>{escape(title)}</figcaption></figure>"
    )
