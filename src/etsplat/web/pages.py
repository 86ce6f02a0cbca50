"""HTML with everything inside: styles, code, data as base64. The JavaScript is in `assets`, one file for each part."""

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from importlib.metadata import version
from importlib.resources import files
from string import Template
from typing import Any

SHARED_SCRIPTS = ("gl.js", "camera.js", "switches.js")
"""What every viewer needs, in the order in which it is read."""

SCENE_SCRIPTS = (
    *("compact.js", "sorter.js", "painter.js", "gl_shaders.js", "gl_painter.js"),
    *("gpu_device.js", "gpu_painter.js", "scene.js"),
)
"""What the viewer of a scene needs beside it."""

SHADERS = ("view", "order", "soft", "opaque", "resolve")
"""By which it draws where a browser has WebGPU."""

SORT_SHADERS = ("common", "block_scan", "sort", "scan")
"""By which it puts triangles into order there, as the engine "webgpu" does."""


@dataclass(frozen=True)
class ScenePage:
    """What a viewer of a scene is made of.

    Attributes:
        title: of the page.
        soup: a compact soup, the file's bytes.
        mesh: the opaque mesh, as a compact file of triangles with colours at corners; None: the soup is drawn opaque.
        view: cameras and places, as `assets/scene.js` reads them.
    """

    title: str
    soup: bytes
    mesh: bytes | None
    view: Mapping[str, Any]


def asset(name: str, package: str = "etsplat.web") -> str:
    """A file of a package's assets, such as base.css, as text."""
    return (files(package) / "assets" / name).read_text(encoding="utf-8")


def filled(template: str, **values: str) -> str:
    """A template with these values in it."""
    return Template(template).substitute(values)


def scripts(*names: str) -> str:
    """Some of the assets, one after the other."""
    return "\n".join(asset(name) for name in names)


def scene_script() -> str:
    """The viewer of a scene, which needs the shared scripts before it."""
    shaders = {name: asset(f"{name}.wgsl") for name in SHADERS}
    engine = files("etsplat.engines.webgpu") / "shaders"
    shaders |= {name: (engine / f"{name}.wgsl").read_text(encoding="utf-8") for name in SORT_SHADERS}
    return f"const SHADERS = {json.dumps(shaders)};\n" + scripts(*SCENE_SCRIPTS)


def in_base64(content: bytes) -> str:
    """Bytes as ASCII."""
    return base64.b64encode(content).decode("ascii")


def render_scene(scene: ScenePage) -> str:
    """The viewer of a scene as a part of a page, which has the shared styles and scripts, scene.css and its own."""
    mesh = "" if scene.mesh is None else f'<script type="text/plain" id="scene-mesh">{in_base64(scene.mesh)}</script>'
    what = "the triangles that are at least half opaque" if scene.mesh is None else "the opaque mesh of the run"
    return filled(
        asset("scene.html"),
        data=json.dumps(scene.view).replace("<", "\\u003c"),  # so that no name ends the script
        soup=in_base64(scene.soup),
        mesh=mesh,
        opaque=what,
    )


def render_scene_page(scene: ScenePage) -> str:
    """A page that is the viewer of a scene and nothing else."""
    return filled(
        asset("scene_page.html"),
        version=version("etsplat"),
        title=escape(scene.title),
        style="\n".join(asset(name) for name in ("base.css", "scene.css")),
        scene=render_scene(scene),
        script="\n".join([scripts(*SHARED_SCRIPTS), scene_script()]),
    )
