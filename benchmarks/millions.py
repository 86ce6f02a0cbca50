"""What millions of triangles take: to export, to draw for the viewer, and until a page shows them.

    python -m benchmarks.millions 1000000 4000000 [--degree 3] [--browser]

A soup made in code: small triangles on a sphere that is bent, with harmonics. A row for each step, in a process of its
own that reads the soup from a file: seconds of its own and of all its threads' processor time, the most memory that it
had, reading included, and the size of what it wrote. With --browser (Chromium, WebGL in software) how long the page
takes until its first picture and until that of all triangles, and the memory of its scripts.
"""

import argparse
import multiprocessing
import resource
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from etsplat.core.cameras import Cameras
from etsplat.model.soup_import import load_soup
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import open_run
from tests.helpers.browser import browser_page

STEPS: dict[str, tuple[str, ExportConfig]] = {
    "GLB": ("soup.glb", ExportConfig()),
    "GLB, --weld": ("welded.glb", ExportConfig(weld=True)),
    "GLB, --compress quantize": ("quantized.glb", ExportConfig(compress="quantize")),
    "GLB, --compress meshopt": ("meshopt.glb", ExportConfig(compress="meshopt")),
    ".etz": ("soup.etz", ExportConfig()),
    ".html": ("soup.html", ExportConfig()),
}
EARLY = """new Promise((done) => {
    const look = () => (document.getElementById("scene").dataset.early ? done(true) : setTimeout(look, 20));
    look();
})"""
WHOLE = "sceneViewer.then((v) => v.settled())"
READING, DRAWING, FINDING = "to read alone", "a picture of the viewer, 960 x 540", ".etz, read"


def make_soup(count: int, degree: int) -> TriangleSoup:
    """Triangles about as large as their distances, most of them opaque, all in colours that depend on the direction."""
    rng = torch.Generator().manual_seed(0)
    middles = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    middles *= 1 + 0.2 * torch.sin(5 * middles[:, :1]) * torch.cos(7 * middles[:, 1:2])
    across = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    other = torch.nn.functional.normalize(torch.linalg.cross(middles, across), dim=1)
    size = 4 / count**0.5
    corners = [middles + size * (a * across + b * other) for a, b in ((1.0, 0.0), (-0.5, 0.87), (-0.5, -0.87))]
    opacities = torch.where(torch.rand(count, generator=rng) < 0.8, 3.0, -1.0)
    rest = 0.1 * torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=rng)
    return TriangleSoup(torch.stack(corners, dim=1), opacities, torch.zeros(count), middles[:, None].clone(), rest)


def act(step: str, folder: Path) -> None:
    """One step, in a process of its own."""
    if step == FINDING:
        load_soup(folder / "soup.etz")
        return
    run = open_run(folder / "soup.safetensors", device="cpu")
    if step in STEPS:
        name, config = STEPS[step]
        export_soup(run, folder / name, config)
    elif step == DRAWING:
        viewmat = torch.eye(4)
        viewmat[2, 3] = 3.0
        K = torch.tensor([[700.0, 0, 480], [0, 700.0, 270], [0, 0, 1]])
        run.soup.render(Cameras(viewmat[None], K[None], 960, 540))


def measured(action: Callable[..., None], *arguments: Any) -> tuple[float, float, float]:
    """Seconds, processor seconds and GB of an action in a fresh process."""
    context = multiprocessing.get_context("spawn")
    mine, other = context.Pipe()
    process = context.Process(target=_report, args=(other, action, arguments))
    process.start()
    other.close()
    try:
        found = mine.recv()
    finally:
        process.join()
    return found


def _report(pipe: Any, action: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    begin, used = time.perf_counter(), time.process_time()
    action(*arguments)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    pipe.send((time.perf_counter() - begin, time.process_time() - used, memory))


def measure(count: int, degree: int, *, browser: bool) -> None:
    with TemporaryDirectory() as place:
        folder = Path(place)
        make_soup(count, degree).save(folder / "soup.safetensors")
        print(f"| {count:,} triangles of degree {degree} | s | processor s | GB | file |\n|---|---|---|---|---|")
        for step in (READING, *STEPS, FINDING, DRAWING):
            seconds, used, memory = measured(act, step, folder)
            size = f"{(folder / STEPS[step][0]).stat().st_size / 1e6:.0f} MB" if step in STEPS else ""
            print(f"| {step} | {seconds:.1f} | {used:.1f} | {memory:.2f} | {size} |", flush=True)
        if browser:
            watch(folder / "soup.html")


def watch(html: Path) -> None:
    """How a page comes to show what it holds; of small scenes there is no early part."""
    with browser_page() as page:
        begin = time.perf_counter()
        page.open(html)
        page.value(EARLY)
        first = time.perf_counter() - begin
        page.value(WHOLE)
        whole = time.perf_counter() - begin
        heap = page.value("performance.memory ? performance.memory.usedJSHeapSize / 2**30 : 0")
        print(f"| the page: first picture, all triangles | {first:.1f}, {whole:.1f} | | {heap:.2f} | |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", nargs="+", type=int)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--browser", action="store_true")
    options = parser.parse_args()
    for count in options.counts:
        measure(count, options.degree, browser=options.browser)


if __name__ == "__main__":
    main()
