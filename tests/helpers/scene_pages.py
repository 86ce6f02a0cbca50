"""Pages of small scenes, what a browser draws on them, and what the rasterizer draws."""

import re

import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import SoupRun

SIZE = (400, 300)


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


def soft_of(soup, camera):
    """What the rasterizer draws of a soup, over its background."""
    return soup.render(camera, backgrounds=torch.tensor([soup.appearance.background])).color[0]


def opaque_of(shown, camera, background=(0.0, 0.0, 0.0)):
    """What it draws of opaque triangles."""
    rgba = shown.render_opaque(camera)[0]
    return rgba[..., :3] + (1 - rgba[..., 3:]) * torch.tensor(background)


def expect_that_refining_ends_as_drawing_at_once(page):
    """Part by part over a small picture, each nearer to the whole one than the small one."""
    page.value("sceneViewer.then(v => v.settled())")
    drawn = """sceneViewer.then(v => {
        const pictures = [], { painter, camera, canvas } = v, take = () => pictures.push(canvas.toDataURL());
        painter.draw(camera, "soft"); take();
        painter.draw(camera, "soft", { scale: 0.1, still: false }); take();
        for (let whole = false, fresh = true; !whole; fresh = false) {
            whole = painter.refine(camera, 0.3, fresh);
            take();
        }
        return pictures;
    })"""
    found = [torch.from_numpy(page.decoded(each.split(",")[1])).float() for each in page.value(drawn)]
    assert len(found) == 2 + 4
    assert torch.equal(found[0], found[-1])
    small, *parts = (decibels(each, found[0]) for each in found[1:-1])
    assert small < min(parts)


def with_a_small_beginning(file):
    """Changes a page so that it is shown when half of its triangles are read."""
    text, constant = file.read_text(encoding="utf-8"), "const EARLY = 1 << 22;"
    assert constant in text
    soup = re.search(r'id="scene-soup">([^<]*)<', text)
    assert soup is not None
    file.write_text(text.replace(constant, f"const EARLY = {len(soup[1]) // 2 & ~3};"), encoding="utf-8")


def mesh_of_a_ball():
    """With colours at its corners."""
    vertices, faces = icosphere(2)
    return MeshFile(vertices.float(), faces, vertex_colors=vertices.float() * 0.5 + 0.5)
