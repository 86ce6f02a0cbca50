"""The page of a scene holds all that it shows, and a browser draws with it what the rasterizer draws."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
import torch

from etsplat.io.run_directory import RunDirectory
from etsplat.model.soup_import import load_soup
from etsplat.report import write_report
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.web.pages import SCENE_SCRIPTS, SHARED_SCRIPTS, asset
from helpers.finished_runs import write_run, write_soup_run
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


def test_a_page_needs_no_network_and_no_other_file(tmp_path, capture):
    names = []

    class Parts(HTMLParser):
        def handle_starttag(self, tag, attrs):
            names.extend(name for name, value in attrs if name in ("src", "href") or (value and "://" in value))

    text = written(tmp_path, make_soup(), capture).read_text(encoding="utf-8")
    Parts().feed(text)
    assert names == []
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest|import\(", text)
    assert "<title>a &lt;b&gt; scene</title>" in text


def test_a_photo_whose_name_would_end_the_script_does_not(tmp_path, capture):
    names = ["</script><b>", *capture.names[1:]]
    text = written(tmp_path, make_soup(), replace(capture, names=names)).read_text(encoding="utf-8")
    data = re.search(r'id="scene-data">(.*?)</script>', text)
    assert data
    cameras = json.loads(data[1])["cameras"]
    assert cameras[0]["name"] == "script><b>"
    assert len(cameras) == 8


def test_parts_of_the_code_stay_small():
    assert all(len(asset(name).splitlines()) < 400 for name in (*SHARED_SCRIPTS, *SCENE_SCRIPTS))


@pytest.mark.parametrize(
    "appearance",
    [
        {"kernel": "elastic", "background": (0.9, 0.5, 0.1)},
        {"kernel": "bilateral", "sh_degree": 1},
        {"kernel": "single_sided", "distance": "sdf", "cull_small": True, "near_plane": 0.2},
        {"kernel": "elastic", "distance": "sdf", "cull_large": 0.4},
    ],
    ids=str,
)
def test_a_browser_draws_what_the_rasterizer_draws(tmp_path, page, capture, appearance):
    """Soft, and opaque without an opaque mesh, at the cameras of photos."""
    soup = make_soup(**appearance)
    page.open(written(tmp_path, soup, capture))
    for photo in (1, 6):
        camera = camera_of(capture, photo)
        soft = soft_of(soup, camera)
        assert float(soft.std()) > 0.1
        assert decibels(picture(page, photo, "soft"), soft) > 40
        assert decibels(picture(page, photo, "opaque"), opaque_of(soup, camera, soup.appearance.background)) > 35
    assert page.errors == []


def test_a_browser_draws_the_opaque_mesh(tmp_path, page, capture):
    """With colours at its corners, where the run has one; without the sky if that is left out."""
    soup = make_soup()
    mesh = mesh_of_a_ball()
    page.open(written(tmp_path, soup, capture, mesh))
    run = SoupRun(tmp_path, soup, capture, mesh)
    assert run.solid is not None
    expected = run.solid.render_opaque(camera_of(capture, 3))[0]
    assert 0.05 < float(expected[..., 3].mean()) < 0.95
    assert decibels(picture(page, 3, "opaque"), expected[..., :3]) > 35
    assert decibels(picture(page, 3, "soft"), soup.render(camera_of(capture, 3)).color[0]) > 40


def test_a_scene_can_be_looked_around_in(tmp_path, page, capture):
    """Dragging turns about what is looked at, keys move, the list goes to photos, help can be read."""
    page.open(written(tmp_path, make_soup(), capture), 400, 300)
    page.value("sceneViewer.then(v => v.settled())")

    def state():
        return page.value("sceneViewer.then(v => [v.camera.eye, v.camera.target, v.camera.forward, v.camera.right])")

    def drag(dx, dy):
        for kind, x, y in (
            ("mousePressed", 200, 100),
            ("mouseMoved", 200 + dx, 100 + dy),
            ("mouseReleased", 200 + dx, 100 + dy),
        ):
            page.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    before = state()
    drag(30, 0)
    after = state()
    assert torch.allclose(torch.tensor(before[1]), torch.tensor(after[1]), atol=1e-6)
    moved = torch.tensor(after[0]) - torch.tensor(before[0])
    assert float(moved @ torch.tensor(before[3])) < -0.1  # what is looked at follows the pointer to the right
    up = torch.tensor(page.value("sceneViewer.then(v => v.camera.up)"))
    drag(0, 30)
    assert float((torch.tensor(state()[0]) - torch.tensor(after[0])) @ up) > 0.1  # and down, seen from higher up
    page.value("sceneViewer.then(v => { v.root.querySelector('[value=fly]').click(); v.canvas.focus(); })")
    before = state()
    drag(30, 0)
    after = state()
    assert before[0] == after[0]
    assert float(torch.tensor(after[2]) @ torch.tensor(before[3])) < -0.05  # what was ahead is to the right now
    page.ask("Input.dispatchKeyEvent", type="keyDown", key="w")
    page.value("new Promise(done => [1, 2].reduce(next => () => requestAnimationFrame(next), done)())")
    page.ask("Input.dispatchKeyEvent", type="keyUp", key="w")
    ahead = torch.tensor(state()[0]) - torch.tensor(after[0])
    assert float(ahead @ torch.tensor(after[2])) > 0
    page.value("sceneViewer.then(v => v.root.querySelector('[data-step=\"1\"]').click())")
    photo = page.value("sceneViewer.then(v => v.photo)")
    eye = capture.centers[photo].float()
    assert torch.allclose(torch.tensor(state()[0]), eye, atol=1e-5)
    page.value("sceneViewer.then(v => v.root.querySelector('[data-open=help]').click())")
    assert page.value("sceneViewer.then(v => v.root.querySelector('[data-help]').checkVisibility())")


def test_a_browser_without_workers_sorts_all_the_same(tmp_path, page, capture):
    soup = make_soup()
    path = written(tmp_path, soup, capture)
    for source in (
        "Worker = class { constructor() { throw new Error(); } }",
        "URL.createObjectURL = () => 'blob:none'",
    ):
        page.open(path, before=source)
        assert decibels(picture(page, 2, "soft"), soup.render(camera_of(capture, 2)).color[0]) > 40


def test_a_browser_without_webgl_says_so(tmp_path, page):
    source = "HTMLCanvasElement.prototype.getContext = () => null"
    page.open(written(tmp_path, make_soup(5)), before=source)
    assert page.value("sceneViewer.then(v => v === null)")
    assert "has no WebGL 2" in page.value("document.body.textContent")


def test_the_mesh_of_a_report_is_drawn(tmp_path, page):
    """By the same camera: the sphere is in the middle of its canvas, nothing in the corner, and no script fails."""
    page.open(write_report(write_run(tmp_path / "run", views=0, steps=2)), 800, 600)
    page.value("document.getElementById('mesh').scrollIntoView({block: 'center'})")
    page.value("new Promise(done => setTimeout(done, 500))")
    shown = torch.from_numpy(page.screenshot())
    assert page.errors == []
    middle, corner = shown[280:320, 380:420], shown[280:320, 60:100]
    assert float(middle.std()) > float(corner.std()) + 0.01


def test_the_report_of_a_soup_shows_its_scene(tmp_path, page):
    """Also where its capture has gone: from one side, opaque and soft."""
    folder = write_soup_run(tmp_path / "run")
    make_soup().save(RunDirectory(folder).soup_path)
    page.open(write_report(folder), 800, 600)
    assert page.value("sceneViewer.then(v => v.scene.cameras.map(camera => camera.name))") == ["overview"]
    for mode in ("soft", "opaque"):
        assert float(picture(page, 0, mode).std()) > 0.1
    assert page.errors == []


def test_pictures_come_back_where_the_device_took_what_it_held(tmp_path, page, capture):
    """As phones do with pages in the background."""
    page.open(written(tmp_path, make_soup(), capture, mesh_of_a_ball()))
    before = [picture(page, 2, mode) for mode in ("soft", "opaque")]
    page.value("sceneViewer.then(v => (window.taken = v.device.gl.getExtension('WEBGL_lose_context')).loseContext())")
    page.value("sceneViewer.then(v => { v.stand(1); return new Promise(done => setTimeout(done, 300)); })")
    assert page.value("sceneViewer.then(v => v.device.lost)")
    page.value("taken.restoreContext()")
    page.value("new Promise(done => setTimeout(done, 300))")
    page.value("sceneViewer.then(v => v.settled())")
    for mode, expected in zip(("soft", "opaque"), before, strict=True):
        assert torch.equal(picture(page, 2, mode), expected)
    assert page.errors == []


def test_a_part_of_a_scene_is_drawn_larger(tmp_path, page, capture):
    """By the switch, as a file of that part is by the rasterizer."""
    soup = replace(small := make_soup(9000), vertices=0.2 * small.vertices)
    page.open(written(tmp_path, soup, capture), 64, 48)
    export_soup(SoupRun(tmp_path, soup, capture, None), tmp_path / "soup.etz", ExportConfig())
    data = (tmp_path / "soup.etz").read_bytes()
    header = json.loads(data[12 : 12 + int.from_bytes(data[8:12], "little")])
    (tmp_path / "soup.etz").write_bytes(data[: -header["chunks"][-1][1]])
    part = load_soup(tmp_path / "soup.etz")
    assert len(part) == 8192
    page.value("sceneViewer.then(v => { v.options.fraction = 0.7; })")
    assert decibels(picture(page, 2, "soft"), part.render(camera_of(capture, 2)).color[0]) > 40
    assert page.value("sceneViewer.then(v => v.painter.enlarged)") == header["enlarged"][1] > 1


def test_a_soft_picture_that_is_refined_ends_as_one_that_is_drawn_at_once(tmp_path, page, capture):
    """Part by part over a small one, each nearer to it than the small one; then nothing is drawn any more."""
    page.open(written(tmp_path, make_soup(), capture), 160, 120)
    expect_that_refining_ends_as_drawing_at_once(page)
    shown = """sceneViewer.then(async v => {
        const { painter } = v, steps = [], draw = painter.draw.bind(painter), refine = painter.refine.bind(painter);
        painter.draw = (camera, mode, how) => { steps.push(how.scale); draw(camera, mode, how); };
        painter.refine = (camera, share, fresh) => {
            const whole = refine(camera, share, fresh);
            steps.push([fresh, whole]);
            return whole;
        };
        [v.moved, v.pace.soft] = [0, SCALE];
        v.step(performance.now());
        await v.settled();
        [painter.draw, painter.refine] = [draw, refine];
        return steps;
    })"""
    for moving, coarse in ((0.3, 0.5), (0.7, 0.7)):
        first, *steps = page.value(shown.replace("SCALE", str(moving)))
        assert first == coarse  # of its size along each side, before any part of the whole one
        assert [fresh for fresh, _ in steps] == [True] + [False] * (len(steps) - 1)
        assert [whole for _, whole in steps] == [False] * (len(steps) - 1) + [True]
        assert len(steps) > 1
    assert page.value(shown.replace("SCALE", "1")) == [[True, True]]


def test_soft_layers_are_added_up_in_as_many_bits_as_there_are(tmp_path, page, capture):
    """32 in software, where 16 take twice the time; fewer where a device has no more."""
    soup = make_soup()
    expected, path = soup.render(camera_of(capture, 1)).color[0], written(tmp_path, soup, capture)
    for missing, held, least in (("", "RGBA32F", 40), ("EXT_float_blend", "RGBA16F", 40), ("EXT_color", "RGBA8", 35)):
        source = f"""const extension = WebGL2RenderingContext.prototype.getExtension;
            WebGL2RenderingContext.prototype.getExtension = function (name) {{
                return "{missing}" && name.startsWith("{missing}") ? null : extension.call(this, name);
            }}"""
        page.open(path, before=source)
        assert page.value(f"sceneViewer.then(v => v.painter.targets.whole.format === v.device.gl.{held})")
        assert decibels(picture(page, 1, "soft"), expected) > least


def test_an_opaque_picture_of_a_moving_camera_is_the_same_but_for_its_edges(tmp_path, page, capture):
    """It has fewer samples, and a depth buffer all the same; drawn smaller, its edges are softer."""
    page.open(written(tmp_path, make_soup(background=(0.9, 0.5, 0.1)), capture))
    still = picture(page, 6, "opaque")
    size = f"width: {SIZE[0]}, height: {SIZE[1]}"
    drawn = f"""sceneViewer.then(async v => {{
        await v.picture({{photo: 6, mode: 'opaque', {size}}});
        const camera = new Camera(v.camera.home, v.scene.radius);
        camera.stand(v.scene.cameras[6], v.scene.focus);
        v.painter.draw(camera, 'opaque', {{scale: SCALE, still: false}});
        return v.canvas;
    }})"""
    for scale, within, least in ((1, 0.9, 25), (0.5, 0.7, 22)):
        moving = torch.from_numpy(page.picture(drawn.replace("SCALE", str(scale)))).float()
        assert float(((moving - still).abs() < 0.02).all(dim=-1).float().mean()) > within
        assert decibels(moving, still) > least
    assert page.errors == []


def test_a_large_scene_is_shown_before_all_of_it_is_read(tmp_path, page, capture):
    """The first chunk alone; then the same picture as of a page that reads everything at once."""
    file = written(tmp_path, make_soup(9000), capture)
    page.open(file)
    expected = picture(page, 2, "soft")
    assert page.value("document.getElementById('scene').dataset.early ?? null") is None
    with_a_small_beginning(file)
    page.open(file)
    assert page.value("sceneViewer.then(v => [v.root.dataset.early, v.soup.count])") == ["4096", 9000]
    assert torch.equal(picture(page, 2, "soft"), expected)
    assert page.errors == []
