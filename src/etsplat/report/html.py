"""`report.html`: one self-contained page about a run, readable offline and for years."""

import io
import json
from html import escape
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from etsplat.io.atomic import atomic_write
from etsplat.io.images import load_rgb
from etsplat.io.mesh_files import load_mesh
from etsplat.io.overview import TestView, draw_overview, spread
from etsplat.report.cards import Metric, cards_of
from etsplat.report.command import reproduce_command
from etsplat.report.curves import curves_of, draw_svg, plot_convergence, short_number
from etsplat.report.data import Run, read_run
from etsplat.report.scene import own_asset, scene_section
from etsplat.tasks.settings import flatten
from etsplat.web.pages import SHARED_SCRIPTS, asset, filled, in_base64, scene_script, scripts

MAX_VIEWS = 12
MAX_PICTURE = 800
"""Test pictures are embedded with at most this many pixels on the longer side."""


FROM_PYTHON = "This run was started from Python, with a mesh or views."


def write_report(run_dir: Path | str) -> Path:
    """Write `report.html`, `convergence.png` and `overview.png` into a finished run directory.

    Args:
        run_dir: a folder that a reconstruction wrote; only its files are read.

    Returns:
        Path of the page.

    Raises:
        InputError: not a finished run, or the folder cannot be written.

    Example:
        >>> etsplat.write_report("runs/owl").name  # what the example of `etsplat.reconstruct` made
        'report.html'
    """
    run = read_run(run_dir)
    plot_convergence(run, run.folder / "convergence.png")
    if run.views:
        with atomic_write(run.folder / "overview.png") as temporary:
            draw_overview(run.views, "opaque" if run.mesh is None else "mesh").save(temporary)
    path = run.folder / "report.html"
    with atomic_write(path) as temporary:
        # A path on Linux may have bytes that are no text.
        temporary.write_text(render_page(run), encoding="utf-8", errors="replace")
    return path


def render_page(run: Run) -> str:
    """The page as text."""
    command = reproduce_command(run.config, version("etsplat"))
    versions = ", ".join(f"{name} {number}" for name, number in run.metrics["versions"].items())
    scene = "" if run.task != "train" else scene_section(run)
    said = {name: v if isinstance(v, str) else json.dumps(v) for name, v in flatten(run.config).items()}
    viewer = own_asset("viewer.js") if run.mesh is not None else scene_script() if scene else ""
    return filled(
        own_asset("page.html"),
        version=version("etsplat"),
        title=escape(_title(run)),
        subtitle=escape(_subtitle(run)),
        verdict="" if run.verdict is None else _verdict(run.verdict),
        style="\n".join([asset("base.css"), asset("scene.css"), own_asset("page.css")]),
        scripts="\n".join([scripts(*SHARED_SCRIPTS), viewer, own_asset("page.js")]),
        metrics="".join(_card(card) for card in cards_of(run)),
        shape=scene if run.mesh is None else _mesh_section(run.mesh),
        views=_views_section(run),
        curves=_curves_section(run),
        command=f"<pre>{escape(command)}</pre>" if command else f"<p>{FROM_PYTHON}</p>",
        versions=escape(versions),
        engine=escape(str(run.metrics["engine"])),
        config="".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in said.items()),
    )


def _title(run: Run) -> str:
    path = run.config["paths"]["source"]
    return "Given from Python" if path is None else Path(path.removeprefix("demo:")).stem


def _verdict(verdict: str) -> str:
    kind = next((kind for kind in ("good", "poor") if verdict.startswith(kind)), "unknown")
    return f'<p class="verdict {kind}">The result is {escape(verdict)}.</p>'


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
        "vertices": in_base64(mesh.vertices.numpy().astype("<f4").tobytes()),
        "faces": in_base64(mesh.faces.numpy().astype("<u4").tobytes()),
        "colors": in_base64(np.rint(colors.numpy() * 255).astype("u1").tobytes()),
    }
    return filled(own_asset("mesh.html"), data=json.dumps(data))


def _views_section(run: Run) -> str:
    views = spread(run.views, MAX_VIEWS)
    if not views:
        return ""
    opaque, label = ("opaque", "Opaque triangles") if run.mesh is None else ("mesh", "Exported mesh")
    shown = "" if len(views) == len(run.views) else f" {len(views)} of {len(run.views)} are shown."
    figures = "".join(_comparison(view, opaque) for view in views)
    return filled(own_asset("views.html"), shown=shown, opaque=opaque, label=label, views=figures)


def _comparison(view: TestView, kind: str) -> str:
    pictures = {"truth": _picture(view.truth), "render": _picture(view.render), "opaque": _picture(view.opaque)}
    return filled(own_asset("view.html"), name=escape(view.name), kind=kind, **pictures)


def _picture(path: Path) -> str:
    image, encoded = load_rgb(path), path.read_bytes()
    if max(image.size) > MAX_PICTURE:
        image.thumbnail((MAX_PICTURE, MAX_PICTURE), Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        image.save(buffer, "PNG")
        encoded = buffer.getvalue()
    return "data:image/png;base64," + in_base64(encoded)


def _curves_section(run: Run) -> str:
    charts = "".join(
        f'<div class="card curve"><h3>{escape(curve.quantity.title)}'
        f'<span class="last">{short_number(curve.mean[-1])}</span></h3>{draw_svg(curve)}</div>'
        for curve in curves_of(run)
    )
    return filled(own_asset("curves.html"), charts=charts) if charts else ""
