"""What a scene to send is worth: sizes, what the compact file costs on test views, and how a browser draws the page.

    python -m benchmarks.sending runs/fox runs/bonsai

A table in Markdown for each run. Pictures of the browser (Chromium, WebGL and WebGPU in software) are compared with
ours from the exact soup and mesh, 400 pixels wide at the first test view. Frames are by WebGL, 1280 x 720 from the
camera that a page begins at, the best of four, with the pixels read back, and those of a camera that turns as they
are shown in the window; and beside them the mean of the processor's seconds, of all of the browser's processes, which
other jobs do not lengthen.
"""

import json
import sys
import time
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.metrics.image import psnr
from etsplat.model.soup_import import load_soup
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import SoupRun, open_run
from etsplat.tasks.scoring import Scorer
from tests.helpers.browser import WEBGPU, Page, browser_page

FRAME = """sceneViewer.then((v) => {
    [v.canvas.width, v.canvas.height] = [1280, 720];
    const begin = performance.now();
    v.painter.draw(v.camera, "MODE", OPTIONS);
    const { gl } = v.device;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    return performance.now() - begin;
})"""
SETTLED = "sceneViewer.then((v) => v.settled())"
REFINE = """sceneViewer.then(async (v) => {
    const { painter } = v, times = [performance.now()];
    const [draw, refine] = [painter.draw.bind(painter), painter.refine.bind(painter)];
    painter.draw = (...given) => { times.push(performance.now()); draw(...given); };
    painter.refine = (...given) => { times.push(performance.now()); return refine(...given); };
    v.change();
    v.moved = 0;
    await v.settled();
    const { gl } = v.device;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    times.push(performance.now());
    [painter.draw, painter.refine] = [draw, refine];
    return times.slice(1);
})"""
COARSE = """sceneViewer.then(async (v) => {
    await v.picture(WANTED);
    const camera = new Camera(v.camera.home, v.scene.radius);
    camera.stand(v.scene.cameras[WANTED.photo], v.scene.focus);
    v.painter.draw(camera, "soft", { scale: 0.5, still: false });
    return v.canvas;
})"""
TURN = """sceneViewer.then((v) => new Promise((done) => {
    const { painter } = v, draw = painter.draw.bind(painter), begin = performance.now();
    let frames = 0;
    v.set("mode", "opaque");
    painter.draw = (camera, mode) => { ++frames; draw(camera, mode, { still: false }); };
    const turn = () => {
        v.camera.turn(0.01, 0);
        v.change();
        if (performance.now() - begin < 4000) { requestAnimationFrame(turn); return; }
        painter.draw = draw;
        done([frames, (performance.now() - begin) / 1000]);
    };
    turn();
}))"""
SORT = """sceneViewer.then(async (v) => {
    const begin = performance.now();
    await v.painter.sorter.sort(v.request());
    return performance.now() - begin;
})"""


def psnr_of(run: SoupRun, soup: TriangleSoup) -> float:
    """Mean over the test views."""
    capture = run.needed_capture()
    scorer = Scorer(capture, run.device, background=soup.appearance.background)
    seen = [scorer.see(soup, view) for view in capture.test]
    return fmean(psnr(view.counting(view.splatted), view.photo) for view in seen)


def decibels(found: Tensor, expected: Tensor) -> float:
    return float(-10 * (found - expected.clamp(0, 1)).square().mean().log10())


def rows_of(run: SoupRun, folder: Path, page: Page) -> list[tuple[str, str]]:
    """What is measured of a run, and what it came to."""
    compact, html = folder / "soup.etz", folder / "soup.html"
    begin = time.perf_counter()
    export_soup(run, compact, ExportConfig())
    seconds = time.perf_counter() - begin
    export_soup(run, html, ExportConfig())
    exact, found = psnr_of(run, run.soup), load_soup(compact)
    rows = [
        ("triangles, of the opaque mesh", f"{len(run.soup):,}, {0 if run.solid is None else len(run.solid):,}"),
        (".safetensors", _size(run.folder / "soup.safetensors")),
        (".etz", f"{_size(compact)}, {compact.stat().st_size / len(run.soup):.1f} bytes a triangle"),
        (".html", _size(html)),
        ("to write .etz", f"{seconds:.1f} s"),
        ("PSNR, exact → .etz", f"{exact:.3f} → {psnr_of(run, found):.3f} dB"),
    ]
    for share in (0.75, 0.5, 0.25, 0.1):
        part = folder / "part.etz"
        count = cut(compact, part, share)
        rows.append((f"of the first {share:.0%} or more: {count:,}", f"{psnr_of(run, load_soup(part)):.2f} dB"))
    return rows + drawn(run, html, page)


def cut(compact: Path, part: Path, share: float) -> int:
    """Writes as many of a file's first chunks as hold at least a share of its triangles; returns how many they hold."""
    data = compact.read_bytes()
    end = 12 + int.from_bytes(data[8:12], "little")
    header, count = json.loads(data[12:end]), 0
    for rows, size in header["chunks"]:
        if count >= share * header["count"]:
            break
        count, end = count + rows, end + size
    part.write_bytes(data[:end])
    return count


def compared(run: SoupRun, html: Path, page: Page, query: str) -> list[tuple[str, str]]:
    """How near its pictures are to ours, by WebGL or by what the query asks for."""
    page.open(html, query=query)
    page.value(SETTLED)
    name, rows = page.value("sceneViewer.then(v => v.device.name)"), []
    photo, camera = _first_test_view(run, 400)
    for mode, ours in _ours(run, camera).items():
        wanted: dict[str, Any] = {"photo": photo, "mode": mode, "width": camera.width, "height": camera.height}
        shown = torch.from_numpy(page.picture(f"sceneViewer.then(v => v.picture({wanted}))")).float()
        rows.append((f"{mode} by {name}, against ours", f"{decibels(shown, ours):.1f} dB"))
    return rows


def drawn(run: SoupRun, html: Path, page: Page) -> list[tuple[str, str]]:
    """What the browser makes of the page."""
    begin = time.perf_counter()
    page.open(html)
    page.value(SETTLED)
    rows = [("until the first whole picture", f"{time.perf_counter() - begin:.1f} s")]
    rows += compared(run, html, page, "")
    with browser_page(*WEBGPU) as another:
        rows += compared(run, html, another, "?draw=webgpu")
    place, camera = _first_test_view(run, 1280)
    wanted = {"photo": place, "mode": "soft", "width": camera.width, "height": camera.height}
    shown = torch.from_numpy(page.picture(COARSE.replace("WANTED", json.dumps(wanted)))).float()
    against = decibels(shown, _ours(run, camera)["soft"])
    rows.append((f"the first soft picture of a camera that stands, {camera.width} pixels wide", f"{against:.1f} dB"))
    page.open(html)
    page.value(SETTLED)
    for name, mode, options in (
        ("opaque, moving", "opaque", "{still: false}"),
        ("opaque, standing", "opaque", "{}"),
        ("soft, moving (a fifth of the width)", "soft", "{scale: 0.2, still: false}"),
        ("soft, the first while standing (half of the width)", "soft", "{scale: 0.5, still: false}"),
        ("soft, standing, at once", "soft", "{}"),
    ):
        frame = FRAME.replace("MODE", mode).replace("OPTIONS", options)
        before = page.processor_seconds()
        best = min(page.value(frame) for _ in range(4))
        seconds = (page.processor_seconds() - before) / 4
        rows.append((f"{name}, 1280 x 720", f"{best:.0f} ms, {1000 / best:.2g} frames/s; processor {seconds:.2f} s"))
    page.value(REFINE)  # finds out how much is drawn at a time
    before = page.processor_seconds()
    times = page.value(REFINE)
    seconds = page.processor_seconds() - before
    longest = max(later - earlier for earlier, later in pairwise(times))
    took = f"{times[-1] - times[0]:.0f} ms in {len(times) - 1} frames, the longest {longest:.0f} ms"
    rows.append(("soft, from standing still to the whole picture, 1280 x 720", f"{took}; processor {seconds:.2f} s"))
    page.open(html, 1280, 720 + _around(page))
    page.value(SETTLED)
    before = page.processor_seconds()
    frames, seconds = page.value(TURN)
    each = (page.processor_seconds() - before) / frames
    took = f"{frames / seconds:.3g} frames/s; processor {each:.3f} s a frame"
    rows.append(("opaque, turned for four seconds in a window that shows 1280 x 720", took))
    rows.append(("to sort and colour", f"{min(page.value(SORT) for _ in range(4)):.0f} ms"))
    return rows


def _first_test_view(run: SoupRun, width: int) -> tuple[int, Cameras]:
    """Its place in the page's list of photos, and its camera, so wide."""
    capture = run.needed_capture()
    photo = capture.test[0]
    camera = capture.cameras[photo]
    place = sorted([*capture.train, *capture.test, *capture.watched]).index(photo)
    return place, camera.scaled(width / camera.width)


def _ours(run: SoupRun, camera: Cameras) -> dict[str, Tensor]:
    behind = torch.tensor([run.soup.appearance.background])
    shown = run.soup if run.solid is None else run.solid
    rgba = shown.render_opaque(camera)[0]
    opaque = rgba[..., :3] + (1 - rgba[..., 3:]) * behind
    return {"soft": run.soup.render(camera, backgrounds=behind).color[0], "opaque": opaque}


def _around(page: Page) -> int:
    """Height of what the page has beside the picture."""
    return round(page.value("innerHeight - document.querySelector('canvas').clientHeight"))


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.2f} MB"


def main(folders: list[str]) -> None:
    for folder in folders:
        run = open_run(folder, device="cpu")
        with TemporaryDirectory() as place, browser_page() as page, torch.no_grad():
            rows = rows_of(run, Path(place), page)
        print(f"| {Path(folder).name} | |\n|---|---|")
        print("\n".join(f"| {name} | {value} |" for name, value in rows), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
