"""`report.html`: one self-contained page about a run, readable offline and for years."""

import base64
import io
import json
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch
from PIL import Image

from etsplat.io.atomic import atomic_write
from etsplat.io.images import open_image
from etsplat.io.mesh_files import load_mesh
from etsplat.io.overview import TestView, draw_overview, spread
from etsplat.report.cards import Metric, cards_of
from etsplat.report.command import reproduce_command
from etsplat.report.curves import curves_of, draw_svg, short_number
from etsplat.report.data import Run, read_run
from etsplat.report.plots import plot_convergence

MAX_VIEWS = 12
MAX_PICTURE = 800
"""Test pictures are embedded with at most this many pixels on the longer side."""


def write_report(run_dir: Path | str) -> Path:
    """Write `report.html`, `convergence.png` and `overview.png` into a finished run directory.

    Args:
        run_dir: a folder that a reconstruction wrote; only its files are read.

    Returns:
        Path of the page.

    Raises:
        InputError: not a finished run, or the folder cannot be written.
    """
    run = read_run(run_dir)
    plot_convergence(run, run.folder / "convergence.png")
    if run.views:
        with atomic_write(run.folder / "overview.png") as temporary:
            draw_overview(run.views, "opaque" if run.mesh is None else "mesh").save(temporary)
    path = run.folder / "report.html"
    with atomic_write(path) as temporary:
        temporary.write_text(render_page(run), encoding="utf-8")
    return path


def render_page(run: Run) -> str:
    """The page as text."""
    return Template(_asset("page.html")).substitute(
        version=version("etsplat"),
        title=escape(_title(run)),
        subtitle=escape(_subtitle(run)),
        style=_asset("page.css"),
        viewer_script=_asset("viewer.js"),
        page_script=_asset("page.js"),
        metrics=_metrics_section(cards_of(run)),
        mesh="" if run.mesh is None else _mesh_section(run.mesh),
        views=_views_section(run),
        curves=_curves_section(run),
        reproduce=_reproduce_section(run),
        config=_config_section(run),
    )


def _asset(name: str) -> str:
    return (files("etsplat.report") / "assets" / name).read_text(encoding="utf-8")


def _title(run: Run) -> str:
    path = run.config["paths"]["source"]
    return "Given from Python" if path is None else Path(path.removeprefix("demo:")).stem


def _subtitle(run: Run) -> str:
    m = run.metrics
    if run.task == "train":
        return (
            "A triangle soup for novel-view synthesis, from photographs by differentiable triangle splatting: "
            f"{m['method']} kernel, preset {m['preset']}, {m['iterations']:,} iterations, "
            f"{m['triangles']:,} triangles, seed {m['seed']}."
        )
    return (
        "Reconstructed from pictures by differentiable triangle splatting: "
        f"{m['method']} kernel, preset {m['preset']}, {m['iterations']:,} iterations, {m['faces']:,} faces, "
        f"seed {m['seed']}."
    )


def _metrics_section(cards: list[Metric]) -> str:
    return f'<section class="metrics" aria-label="Metrics">{"".join(_card(card) for card in cards)}</section>'


def _card(metric: Metric) -> str:
    if metric.value is None:
        value = '<div class="value missing">not measured</div>'
    else:
        value = f'<div class="value">{escape(metric.value)} <small>{escape(metric.unit)}</small></div>'
    return f'<div class="card metric"><h3>{escape(metric.title)}</h3>{value}<p>{escape(metric.meaning)}</p></div>'


def _mesh_section(path: Path) -> str:
    mesh = load_mesh(path)
    colors = torch.full((len(mesh.faces), 3), 0.8) if mesh.face_colors is None else mesh.face_colors
    if mesh.vertex_colors is not None:
        colors = mesh.vertex_colors[mesh.faces].mean(dim=1)
    data = {
        "vertices": _base64(mesh.vertices.numpy().astype("<f4").tobytes()),
        "faces": _base64(mesh.faces.numpy().astype("<u4").tobytes()),
        "colors": _base64(np.rint(colors.numpy() * 255).astype("u1").tobytes()),
    }
    return f"""<section>
<h2>The mesh</h2>
<p class="note">Drag to turn, wheel to zoom, shift-drag to move, double-click to start over; arrow keys work too.
Colours are the reconstructed ones, with the photographs' light in them. In the shape view, orange is the inside of a
face.</p>
<div class="bar">
<div class="group" id="mesh-surface"><button type="button" value="colors" aria-pressed="true">Colours</button><button
type="button" value="shape" aria-pressed="false">Shape</button></div>
<button type="button" id="mesh-wireframe" aria-pressed="false">Wireframe</button>
</div>
<div class="card stage">
<canvas id="mesh" tabindex="0" aria-label="The reconstructed mesh, to turn around"></canvas>
</div>
<script type="application/json" id="mesh-data">{json.dumps(data)}</script>
</section>"""


def _views_section(run: Run) -> str:
    views = spread(run.views, MAX_VIEWS)
    if not views:
        return ""
    opaque, label = ("opaque", "Opaque triangles") if run.mesh is None else ("mesh", "Exported mesh")
    shown = "" if len(views) == len(run.views) else f" {len(views)} of {len(run.views)} are shown."
    return f"""<section>
<h2>Test views</h2>
<p class="note">Pictures that training never saw, beside the render. Drag the edge across a picture.{shown} The
originals are in <code>test/</code>.</p>
<div class="bar">
<div class="group" id="compare-mode"><button type="button" value="slide" aria-pressed="true">Slide</button><button
type="button" value="side" aria-pressed="false">Side by side</button><button type="button" value="difference"
aria-pressed="false">Difference × 4</button></div>
<div class="group" id="compare-with"><button type="button" value="render" aria-pressed="true">Splatted
render</button><button type="button" value="{opaque}" aria-pressed="false">{label}</button></div>
</div>
<div id="views" data-mode="slide" data-shown="render">{"".join(_comparison(view, opaque) for view in views)}</div>
</section>"""


def _comparison(view: TestView, kind: str) -> str:
    name = escape(view.name)
    truth, render, opaque = (_picture(path) for path in (view.truth, view.render, view.opaque))
    return f"""<figure class="card"><div class="compare">
<img src="{truth}" alt="View {name}: photograph">
<img class="shown" src="{render}" data-render="{render}" data-{kind}="{opaque}" alt="View {name}: render">
<input type="range" min="0" max="100" value="50" aria-label="Where the photograph ends and the render begins">
<span class="edge"></span><span class="tag truth">photograph</span><span class="tag other"></span>
</div><figcaption>View {name}</figcaption></figure>"""


def _picture(path: Path) -> str:
    with open_image(path) as image:
        image = image.convert("RGB")
    image.thumbnail((MAX_PICTURE, MAX_PICTURE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + _base64(buffer.getvalue())


def _curves_section(run: Run) -> str:
    charts = "".join(
        f'<div class="card curve"><h3>{escape(curve.quantity.title)}'
        f'<span class="last">{short_number(curve.mean[-1])}</span></h3>{draw_svg(curve)}</div>'
        for curve in curves_of(run)
    )
    if not charts:
        return ""
    return f"""<section>
<h2>Convergence</h2>
<p class="note">Over iterations. Where many steps share a point of a curve, the line is their mean and the band their
range; for softness and opacity of a soup, the median and 10 to 90 % of the triangles.</p>
<div class="curves">{charts}</div>
</section>"""


def _reproduce_section(run: Run) -> str:
    command = reproduce_command(run.config, version("etsplat"))
    shown = (
        f"<pre>{escape(command)}</pre>" if command else "<p>This run was started from Python, with a mesh or views.</p>"
    )
    versions = ", ".join(f"{name} {number}" for name, number in run.metrics["versions"].items())
    return f"""<section>
<h2>Run it again</h2>
{shown}
<p class="note">Made with {escape(versions)}, engine {escape(str(run.metrics["engine"]))}. The same settings on the same
machine, torch and number of threads give the same bits.</p>
</section>"""


def _config_section(run: Run) -> str:
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in _flatten(run.config))
    summary = "<summary>Every setting of this run</summary>"
    return f'<section><details class="card">{summary}<table>{rows}</table></details></section>'


def _flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(value, dict):
        return [row for key, item in value.items() for row in _flatten(item, f"{prefix}.{key}" if prefix else str(key))]
    return [(prefix, value if isinstance(value, str) else json.dumps(value))]


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
