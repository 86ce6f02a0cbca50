"""The scene of a run of `etsplat train` on its page, to look around in."""

from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.core.kernels import KERNELS
from etsplat.io.opaque_files import load_opaque
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.report.data import Run
from etsplat.tasks.demos import DEMO_SCENE
from etsplat.tasks.opened_runs import SoupRun, open_run
from etsplat.tasks.scene_page import scene_of
from etsplat.web.pages import asset, filled, render_scene

MOST_TRIANGLES = 100_000
"""Of a larger soup the most important ones are on the page: it is to be opened on any device."""


def own_asset(name: str) -> str:
    """A file of the report's parts, such as page.css, as text."""
    return asset(name, "etsplat.report")


def scene_section(run: Run) -> str:
    """The viewer of the scene; nothing of an empty one, or of kernels from Python, which browsers have no code for.

    Raises:
        InputError: the soup or the opaque mesh is damaged.
    """
    opened = _opened(run)
    if not len(opened.soup) or KERNELS[opened.soup.appearance.kernel].table is not None:
        return ""
    scene = scene_of(opened, opened.soup, opened.solid, most=MOST_TRIANGLES)
    more = "" if len(opened.soup) <= MOST_TRIANGLES else f" The {MOST_TRIANGLES:,} most important triangles are here."
    return filled(own_asset("scene.html"), scene=render_scene(scene), more=more)


def _opened(run: Run) -> SoupRun:
    """The soup with its capture if that is still there; cameras are all that is taken of it."""
    if run.config["paths"]["source"] != DEMO_SCENE:  # which would be photographed anew
        try:
            return open_run(run.folder, device="cpu")
        except InputError:  # the capture has gone, or something is damaged: what is, is named below
            pass
    directory = RunDirectory(run.folder)
    opaque = load_opaque(directory.opaque_path) if directory.opaque_path.is_file() else None
    return SoupRun(Path(run.folder), TriangleSoup.load(directory.soup_path), None, opaque)
