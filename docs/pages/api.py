"""The API reference: each name of `src/etsplat/__init__.pyi` once, under the topic that its module belongs to."""

import ast
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import etsplat

TOPICS: Mapping[str, tuple[str, str, tuple[str, ...]]] = {
    "rendering": (
        "Rendering",
        "Triangles to pictures, with gradients.",
        ("ops.rasterize", "ops", "core.registered_kernels", "core.rasterization"),
    ),
    "cameras": ("Cameras and paths", "Where pictures are taken from.", ("core.cameras", "data.camera_paths")),
    "data": ("Posed photos", "Captures, photographs of a mesh, and what is built in code.", ("data",)),
    "models": ("Models", "Triangles that learn, and how they are drawn.", ("model",)),
    "training": (
        "Training",
        "The trainer, its strategies, schedules and events.",
        ("optim", "ops.adam", "core.workers"),
    ),
    "losses": (
        "Losses and terms",
        "What is minimised.",
        ("optim.objective", "optim.terms", "ops.mesh_energies", "ops.normal_consistency", "ops.photometric"),
    ),
    "metrics": ("Metrics", "How good a result is.", ("metrics", "tasks.scoring")),
    "geometry": ("Geometry", "Connectivity and subdivision.", ("geometry",)),
    "files": ("Files", "Meshes, images, videos, reports.", ("io", "report", "core.errors")),
    "runs": ("Whole runs", "What the command line calls.", ("tasks",)),
    "engines": ("Engines and threads", "What computes, and on how many cores.", ("engines",)),
}
"""By page: title, one line, and the modules whose names it has; in their order, and of two that fit
the longer one."""


def public_names() -> dict[str, str]:
    """The public names in their order, with the modules that they come from."""
    statements = ast.parse(Path(f"{etsplat.__file__}i").read_text(encoding="utf-8")).body
    return {s.names[0].name: s.module for s in statements if isinstance(s, ast.ImportFrom) and s.module}


def topic_of(module: str) -> tuple[str, int]:
    """The page that has the names of a module, and the place on it.

    Raises:
        KeyError: no topic has it.
    """
    own = f"{module.removeprefix('etsplat.')}."
    fitting = {
        start: (page, place)
        for page, (_, _, starts) in TOPICS.items()
        for place, start in enumerate(starts)
        if own.startswith(f"{start}.")
    }
    if not fitting:
        raise KeyError(f"{module}: has a public name, but no topic in docs/pages/api.py")
    return fitting[max(fitting, key=len)]


def api_pages() -> dict[str, str]:
    """A page for each topic, and one that lists them."""
    names: dict[str, list[str]] = {page: [] for page in TOPICS}
    homes = {name: topic_of(module) for name, module in public_names().items()}
    for name in sorted(homes, key=lambda name: homes[name][1]):
        names[homes[name][0]].append(name)
    pages = {f"api/{page}.rst": _page(page, names[page]) for page in TOPICS}
    rows = [f":doc:`{TOPICS[page][0]} <{page}>`\n   {TOPICS[page][1]} {_links(names[page])}\n" for page in TOPICS]
    toc = ["", ".. toctree::", "   :hidden:", "", *(f"   {page}" for page in TOPICS), ""]
    return pages | {"api/index.rst": "\n".join([*_title("API reference"), _ABOUT, "", *rows, *toc])}


_ABOUT = (
    "Everything that ``import etsplat`` offers. Capital letters in shapes are sizes: ``N`` triangles, ``V`` vertices,\n"
    "``B`` views, ``H`` and ``W`` pixels, ``C`` channels. :doc:`/docs/conventions` says what axes and colours\n"
    "mean. The examples know ``torch`` and ``etsplat``, and the tests run them."
)


def _page(page: str, names: list[str]) -> str:
    title, line, _ = TOPICS[page]
    return "\n".join([*_title(title), line, "", *(text for name in names for text in _entry(name))])


def _title(text: str) -> list[str]:
    return [text, "=" * len(text), ""]


def _links(names: list[str]) -> str:
    return ", ".join(f":py:obj:`~etsplat.{name}`" for name in names) + "."


def _entry(name: str) -> list[str]:
    value: Any = getattr(etsplat, name)
    if not inspect.isclass(value):
        return [f".. autofunction:: etsplat.{name}", ""]
    if issubclass(value, BaseException):
        return [f".. autoexception:: etsplat.{name}", ""]
    return [f".. autoclass:: etsplat.{name}", "   :members:", ""]
