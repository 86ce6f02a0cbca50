"""By WebGPU a page draws what the rasterizer and WebGL draw. Chromium has it in software, used if asked for."""

import json
from dataclasses import replace

import pytest
import torch

from etsplat.model.soup_import import load_soup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.web.pages import asset
from helpers.browser import WEBGPU
from helpers.scene_pages import (
    SIZE,
    camera_of,
    decibels,
    expect_that_refining_ends_as_drawing_at_once,
    make_soup,
    mesh_of_a_ball,
    opaque_of,
    picture,
    soft_of,
    with_a_small_beginning,
    written,
)


@pytest.fixture(scope="module")
def flags():
    return WEBGPU


ASKED = "?draw=webgpu"
HARDWARE = "Object.defineProperty(GPUAdapterInfo.prototype, 'isFallbackAdapter', { get: () => false });"
DEVICE = "sceneViewer.then(v => [v.device.name, document.querySelector('[data-device]').textContent])"


def open_by_webgpu(page, path, width=320, height=240):
    page.open(path, width, height, query=ASKED)
    if page.value("navigator.gpu?.requestAdapter().then(Boolean) ?? false") is False:
        pytest.skip("this Chromium has no WebGPU")
    assert page.value(DEVICE) == ["WebGPU", "WebGPU"]


@pytest.mark.parametrize(
    "appearance",
    [
        {"kernel": "elastic", "background": (0.9, 0.5, 0.1)},
        {"kernel": "bilateral", "sh_degree": 1},
        {"kernel": "single_sided", "distance": "sdf", "cull_small": True, "near_plane": 0.2},
        {"kernel": "elastic", "distance": "sdf", "cull_large": 0.4, "sh_degree": 2},
        {"kernel": "hard", "sh_degree": 0},  # whose edges differ by whole pixels
    ],
    ids=str,
)
def test_webgpu_draws_what_the_rasterizer_draws(tmp_path, page, capture, appearance):
    """And what WebGL draws."""
    soup = make_soup(**appearance)
    path = written(tmp_path, soup, capture)
    page.open(path, 320, 240)
    assert page.value(DEVICE) == ["WebGL 2", "WebGL 2"]  # where nothing is asked for: it is faster in software
    by_webgl = {mode: picture(page, 6, mode) for mode in ("soft", "opaque")}
    open_by_webgpu(page, path)
    camera, background = camera_of(capture, 6), soup.appearance.background
    soft, least = picture(page, 6, "soft"), 30 if appearance["kernel"] == "hard" else 40
    assert decibels(soft, soft_of(soup, camera)) > least
    assert decibels(picture(page, 6, "opaque"), opaque_of(soup, camera, background)) > 35
    assert decibels(soft, by_webgl["soft"]) > 50
    assert decibels(picture(page, 6, "opaque"), by_webgl["opaque"]) > 40  # other places within a pixel are asked
    assert page.errors == []


def test_webgpu_draws_the_opaque_mesh(tmp_path, page, capture):
    mesh = mesh_of_a_ball()
    open_by_webgpu(page, written(tmp_path, make_soup(), capture, mesh))
    solid = SoupRun(tmp_path, make_soup(), capture, mesh).solid
    camera = camera_of(capture, 3)
    assert decibels(picture(page, 3, "opaque"), opaque_of(solid, camera)) > 35
    moving = """sceneViewer.then(async v => {
        await v.picture({photo: 3, mode: 'opaque', width: 400, height: 300});
        const camera = new Camera(v.camera.home, v.scene.radius);
        camera.stand(v.scene.cameras[3], v.scene.focus);
        v.painter.draw(camera, 'opaque', {still: false});
        return v.canvas;
    })"""
    difference = torch.from_numpy(page.picture(moving)).float() - picture(page, 3, "opaque")
    assert float((difference.abs() < 0.02).all(dim=-1).float().mean()) > 0.9
    assert page.errors == []


def test_every_frame_has_its_own_order(tmp_path, page, capture):
    """At once, from where the camera is, of many workgroups; triangles of one depth are as in the file."""
    made = make_soup(5000)
    soup = replace(made, vertices=torch.cat([made.vertices[:2500]] * 2))
    open_by_webgpu(page, written(tmp_path, soup, capture), 64, 48)
    page.value("sceneViewer.then(v => v.settled())")
    export_soup(SoupRun(tmp_path, soup, capture, None), tmp_path / "soup.etz", ExportConfig())
    in_file = load_soup(tmp_path / "soup.etz")
    drawn = """sceneViewer.then(v => [5, 2, 7].map(photo => {
        v.stand(photo);
        const ordered = v.painter.order(v.request());
        [v.canvas.width, v.canvas.height] = SIZE;
        v.painter.draw(v.camera, 'soft');
        return [ordered, v.canvas.toDataURL()];
    }))""".replace("SIZE", json.dumps(SIZE))
    for photo, (ordered, found) in zip((5, 2, 7), page.value(drawn), strict=True):
        assert ordered
        shown = torch.from_numpy(page.decoded(found.split(",")[1])).float()
        assert decibels(shown, in_file.render(camera_of(capture, photo)).color[0]) > 40
    assert page.errors == []


def test_a_soft_picture_is_refined_by_webgpu_too(tmp_path, page, capture):
    open_by_webgpu(page, written(tmp_path, make_soup(), capture), 160, 120)
    expect_that_refining_ends_as_drawing_at_once(page)
    page.value("sceneViewer.then(v => v.settled())")
    assert page.errors == []


def test_pictures_come_back_where_webgpu_lost_its_device(tmp_path, page, capture):
    open_by_webgpu(page, written(tmp_path, make_soup(), capture, mesh_of_a_ball()))
    before = [picture(page, 2, mode) for mode in ("soft", "opaque")]
    page.value("""sceneViewer.then(v => new Promise(done => {
        const restore = v.device.returned;
        v.device.returned = () => { restore(); done(true); };
        v.device.device.destroy();
        v.stand(1);
    }))""")
    page.value("sceneViewer.then(v => v.settled())")
    for mode, expected in zip(("soft", "opaque"), before, strict=True):
        assert torch.equal(picture(page, 2, mode), expected)
    assert page.errors == []


def test_webgpu_of_hardware_is_used_without_being_asked_for(tmp_path, page, capture):
    """But not where WebGL is asked for."""
    path = written(tmp_path, make_soup(5), capture)
    for query, name in (("", "WebGPU"), ("?draw=webgl", "WebGL 2")):
        page.open(path, 320, 240, query=query, before=HARDWARE)
        assert page.value(DEVICE) == [name, name]
    assert page.errors == []


@pytest.mark.parametrize(
    "source",
    [
        "Object.defineProperty(Navigator.prototype, 'gpu', { value: undefined })",
        "GPU.prototype.requestAdapter = async () => null",
        "GPUAdapter.prototype.requestDevice = async () => { throw new Error('none'); }",
        "GPUDevice.prototype.createRenderPipelineAsync = async () => { throw new Error('not this program'); }",
        "Object.defineProperty(GPUSupportedLimits.prototype, 'maxBufferSize', { get: () => 4096 })",
    ],
    ids=["none", "no adapter", "no device", "a program is refused", "too small"],
)
def test_where_webgpu_fails_webgl_draws(tmp_path, page, capture, source):
    """Without a word to who looks; who asked for WebGPU is told."""
    soup = make_soup()
    path = written(tmp_path, soup, capture)
    page.open(path, 320, 240, before=HARDWARE + source)
    assert page.value(DEVICE) == ["WebGL 2", "WebGL 2"]
    assert decibels(picture(page, 1, "soft"), soup.render(camera_of(capture, 1)).color[0]) > 40
    page.open(path, 320, 240, query=ASKED, before=HARDWARE + source)
    assert page.value("sceneViewer.then(v => v === null)")
    assert "has no WebGPU that can show it" in page.value("document.body.textContent")
    assert page.errors == []


def test_a_large_scene_is_shown_by_webgpu_before_all_of_it_is_read(tmp_path, page, capture):
    file = written(tmp_path, make_soup(9000), capture)
    open_by_webgpu(page, file)
    expected = picture(page, 2, "soft")
    with_a_small_beginning(file)
    open_by_webgpu(page, file)
    assert page.value("sceneViewer.then(v => [v.root.dataset.early, v.soup.count])") == ["4096", 9000]
    assert torch.equal(picture(page, 2, "soft"), expected)
    assert page.errors == []


def test_its_shaders_are_valid_for_another_compiler():
    """Of Firefox, which wgpu has too: every program, every kernel."""
    wgpu = pytest.importorskip("wgpu")
    try:
        device = wgpu.gpu.request_adapter_sync().request_device_sync()
    except Exception as reason:  # of whatever kind
        pytest.skip(f"there is no GPU, not even in software: {reason}")

    def render(names, vertex, fragment, constants, target, **more):
        module = device.create_shader_module(code="".join(asset(f"{name}.wgsl") for name in names))
        device.create_render_pipeline(
            layout="auto",
            vertex={"module": module, "entry_point": f"{vertex}_vertex", "constants": constants},
            fragment={
                "module": module,
                "entry_point": f"{fragment}_fragment",
                "targets": [{"format": target}],
                "constants": {name: value for name, value in constants.items() if name == "KERNEL"},
            },
            **more,
        )

    for degree in range(4):
        module = device.create_shader_module(code=asset("view.wgsl") + asset("order.wgsl"))
        compute = {"module": module, "entry_point": "look", "constants": {"DEGREE": degree}}
        device.create_compute_pipeline(layout="auto", compute=compute)
    for kernel in range(4):
        render(("view", "soft"), "soft", "soft", {"KERNEL": kernel, "SDF": kernel % 2}, "rgba16float")
    depth = {"format": "depth24plus", "depth_write_enabled": True, "depth_compare": "less"}
    for vertex in ("mesh", "soup"):
        render(("view", "opaque"), vertex, "opaque", {}, "rgba8unorm", depth_stencil=depth)
    render(("resolve",), "resolve", "resolve", {}, "bgra8unorm")
