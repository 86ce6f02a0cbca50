"""Every switch of a scene's page, operated as a person does: what the window shows changes to what the switch says."""

import json

import pytest
import torch
from torch.nn import functional

from etsplat.model.soup_import import load_soup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import SoupRun
from helpers.scene_pages import camera_of, decibels, make_soup, opaque_of, soft_of, written

BACKGROUND = (0.2, 0.4, 0.6)
DOWN = ("ArrowDown", 40)


@pytest.fixture
def soup():
    return make_soup(300, background=BACKGROUND)


@pytest.fixture
def shown(tmp_path, page, soup, capture):
    """A page whose canvas is 400 x 300, and what the window has of it when nothing changes any more."""
    path = written(tmp_path, soup, capture)
    page.open(path, 400, 600)
    around = 600 - round(page.box("canvas")[3])
    page.open(path, 400, 300 + around)
    page.value("sceneViewer")  # switches answer from here on

    def canvas():
        page.value("sceneViewer.then(v => v.settled())")
        left, top, width, height = (round(side) for side in page.box("canvas"))
        assert (width, height) == (400, 300)
        return torch.from_numpy(page.screenshot()).float()[top : top + height, left : left + width]

    yield canvas
    assert page.errors == []


def pressed(page, group):
    chosen = f"document.querySelectorAll('[data-switch={group}] [aria-pressed=true]')"
    return page.value(f"[...{chosen}].map(button => button.value)")


def test_soft_and_opaque(page, shown, soup, capture):
    camera = camera_of(capture, page.value("sceneViewer.then(v => v.photo)"))
    assert pressed(page, "mode") == ["soft"]
    assert decibels(shown(), soft_of(soup, camera)) > 40
    page.click("[data-switch=mode] [value=opaque]")
    assert pressed(page, "mode") == ["opaque"]
    assert decibels(shown(), opaque_of(soup, camera, BACKGROUND)) > 35
    assert decibels(shown(), soft_of(soup, camera)) < 30
    page.click("[data-switch=mode] [value=soft]")
    assert decibels(shown(), soft_of(soup, camera)) > 40


def test_photos_by_list_and_by_steps(page, shown, soup, capture):
    """In a circle; a double click and 0 go back to the photo after a look elsewhere."""
    first = page.value("sceneViewer.then(v => v.photo)")

    def expect(photo):
        assert page.value("document.querySelector('[data-list=photos]').value") == str(photo)
        name = "document.querySelector('[data-list=photos]').selectedOptions[0].textContent"
        assert page.value(name) == capture.names[photo]
        assert decibels(shown(), soft_of(soup, camera_of(capture, photo))) > 40

    expect(first)
    page.click("[data-step='1']")
    expect((first + 1) % 8)
    for _ in range(2):
        page.click("[data-step='-1']")
    expect((first - 1) % 8)
    page.value("document.querySelector('[data-list=photos]').focus()")
    page.press("Home", 36)
    expect(0)
    page.press(*DOWN)
    expect(1)
    page.drag("canvas", 60, 20)
    assert decibels(shown(), soft_of(soup, camera_of(capture, 1))) < 30
    page.press("0", 48)  # the drag gave the canvas the focus
    expect(1)


@pytest.mark.parametrize("soup", [make_soup(9000, background=BACKGROUND)], ids=["several chunks"])
def test_a_fraction(tmp_path, page, shown, soup, capture):
    """As a file cut off there is drawn."""
    export_soup(SoupRun(tmp_path, soup, capture, None), tmp_path / "soup.etz", ExportConfig())
    data = (tmp_path / "soup.etz").read_bytes()
    begin = 12 + int.from_bytes(data[8:12], "little")
    sizes = [size for _, size in json.loads(data[12:begin])["chunks"]]
    camera = camera_of(capture, page.value("sceneViewer.then(v => v.photo)"))
    page.value("document.querySelector('[data-list=fraction]').focus()")
    for asked, chunks, count in (("0.5", 2, 8192), ("0.25", 1, 4096), ("0.125", 1, 4096)):
        page.press(*DOWN)
        assert page.value("document.querySelector('[data-list=fraction]').value") == asked
        (tmp_path / "part.etz").write_bytes(data[: begin + sum(sizes[:chunks])])
        part = load_soup(tmp_path / "part.etz")
        assert len(part) == count
        assert decibels(shown(), soft_of(part, camera)) > 40
    assert decibels(shown(), soft_of(soup, camera)) < 35
    page.click("[data-switch=mode] [value=opaque]")
    assert (
        decibels(shown(), opaque_of(part, camera, BACKGROUND))
        > 35
        > decibels(shown(), opaque_of(soup, camera, BACKGROUND))
    )
    page.click("[data-switch=mode] [value=soft]")
    page.value("document.querySelector('[data-list=fraction]').focus()")
    page.press("Home", 36)
    assert decibels(shown(), soft_of(soup, camera)) > 40


@pytest.mark.parametrize("mode", ["soft", "opaque"])
def test_half_size(page, shown, soup, capture, mode):
    """Half as many pixels along each side, made as large as the others by the browser."""
    camera = camera_of(capture, page.value("sceneViewer.then(v => v.photo)"))
    page.click(f"[data-switch=mode] [value={mode}]")
    whole = shown()
    page.value("document.querySelector('[data-list=resolution]').focus()")
    page.press(*DOWN)
    half = shown()
    assert page.value("sceneViewer.then(v => [v.canvas.width, v.canvas.height])") == [200, 150]
    smaller = camera.scaled(0.5)
    drawn = soft_of(soup, smaller) if mode == "soft" else opaque_of(soup, smaller, BACKGROUND)
    small = drawn.movedim(-1, 0)[None]
    enlarged = functional.interpolate(small, size=(300, 400), mode="bilinear")[0].movedim(0, -1)
    assert decibels(half, enlarged) > decibels(half, whole) + 3
    page.press("ArrowUp", 38)
    assert torch.equal(shown(), whole)


def test_orbit_and_fly(page, shown):
    """To orbit keeps the target; to fly keeps the place, and turns the other way."""

    def state():
        return torch.tensor(page.value("sceneViewer.then(v => [v.camera.eye, v.camera.target, v.camera.forward])"))

    for motion, kept, turned in (("fly", 0, 1), ("orbit", 1, 0)):
        page.click(f"[data-switch=motion] [value={motion}]")
        assert pressed(page, "motion") == [motion]
        before, seen = state(), shown()
        page.drag("canvas", 40, 0)
        after = state()
        assert torch.allclose(before[kept], after[kept], atol=1e-5)
        assert float((before[turned] - after[turned]).norm()) > 0.1
        assert decibels(shown(), seen) < 30


def test_help_and_theme(page, shown):
    """Both are there and away again; the theme does not change the scene."""
    seen = shown()
    page.click("[data-open=help]")
    assert decibels(shown(), seen) < 20
    page.press("Escape", 27)
    assert torch.equal(shown(), seen)
    page.click("[data-open=help]")
    page.click("[data-help]")
    assert torch.equal(shown(), seen)
    corner = page.screenshot()[2, 2]
    page.click("#theme")
    assert abs(page.screenshot()[2, 2] - corner).mean() > 0.5
    assert torch.equal(shown(), seen)


@pytest.mark.parametrize(("width", "height"), [(360, 640), (844, 390)])
def test_a_phone_has_room_for_every_switch_and_fingers_move_the_scene(tmp_path, page, soup, capture, width, height):
    """Upright and lying: nothing is cut off or covered; a finger turns, two go nearer."""
    page.open(written(tmp_path, soup, capture), width, height, phone=True)
    page.value("sceneViewer.then(v => v.settled())")
    assert page.value("document.documentElement.scrollWidth <= innerWidth && document.body.scrollHeight <= innerHeight")
    assert page.box("canvas")[3] > height / 2
    found = "[...document.querySelectorAll('button, select')].filter(part => part.checkVisibility())"
    count = page.value(f"(window.parts = {found}).length")
    assert count == 11
    reached = """parts.map(part => {
        const { x, y, width, height } = part.getBoundingClientRect();
        return part.contains(document.elementFromPoint(x + width / 2, y + height / 2)) && height >= 28;
    })"""
    assert page.value(reached) == [True] * count

    def state():
        return page.value("sceneViewer.then(v => [v.camera.distance, ...v.camera.eye])")

    def fingers(*steps):
        for kind, points in steps:
            touches = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(points)]
            page.ask("Input.dispatchTouchEvent", type=kind, touchPoints=touches)

    x, y = width / 2, 150
    before = state()
    fingers(("touchStart", [(x, y)]), ("touchMove", [(x + 40, y)]), ("touchEnd", []))
    turned = state()
    assert abs(turned[0] - before[0]) < 1e-4
    assert torch.tensor(turned).sub(torch.tensor(before)).norm() > 0.1
    apart = [(x - 40, y), (x + 40, y)], [(x - 80, y), (x + 80, y)]
    fingers(("touchStart", apart[0]), ("touchMove", apart[1]), ("touchEnd", []))
    assert state()[0] == pytest.approx(turned[0] / 2, rel=0.05)
    assert page.errors == []
