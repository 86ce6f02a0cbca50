"""Pages of small scenes, what a browser draws on them, and what the rasterizer draws."""

import torch

from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.sources import SoupRun

SIZE = (400, 300)
STILL = """new Promise((done) => {
    const look = () => { if (v.frame || v.sorting || !v.sorted) setTimeout(look, 50); else done(true); };
    look();
})"""


def make_soup(count=150, **appearance):
    """Triangles around the origin, with colours that depend on the direction, before a large one and a far one."""
    rng = torch.Generator().manual_seed(5)
    corners = torch.randn(count, 1, 3, generator=rng) * 0.6 + torch.randn(count, 3, 3, generator=rng) * 0.25
    corners[0], corners[1] = 4 * corners[0], 20 * corners[1]
    made = TriangleSoup.from_triangles(
        corners, torch.rand(count, 3, generator=rng), opacity=0.5, sigma=0.5, sh_degree=3
    )
    state = made.state()
    state["opacity_logits"] = torch.randn(count, generator=rng) * 2 + 1
    state["sigma_raw"] = torch.randn(count, generator=rng) * 0.8 - 1
    state["sh_rest"] = torch.randn(count, 15, 3, generator=rng) * 0.1
    return TriangleSoup(**state, appearance=SoupAppearance(**appearance))


def written(tmp_path, soup, capture=None, opaque=None, **config):
    path = tmp_path / "a <b> scene.html"
    run = SoupRun(path.with_suffix(".safetensors"), soup, capture, opaque)
    export_soup(run, path, ExportConfig(**config))
    return path


def picture(page, photo, mode):
    drawn = f"v.picture({{photo: {photo}, mode: '{mode}', width: {SIZE[0]}, height: {SIZE[1]}}})"
    return torch.from_numpy(page.picture(f"sceneViewer.then(v => {drawn})")).float()


def decibels(a, b):
    return float(-10 * (a.clamp(0, 1) - b.clamp(0, 1)).square().mean().log10())


def camera_of(capture, index):
    camera = capture.cameras[index]
    return camera.scaled(SIZE[0] / camera.width)
