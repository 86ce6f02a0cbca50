"""The controls: crop, photos, films and snapshots, whatever a browser says."""

import io
import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image

from etsplat.core.cameras import Cameras
from etsplat.data.load import load_dataset
from etsplat.data.looked_at import middle_photo
from etsplat.geometry.regions import Sphere
from etsplat.io.camera_path_files import read_camera_path
from etsplat.tasks.opened_runs import SoupRun
from etsplat.viewer.pictures import MODES, beside_photo, cropped, picture
from etsplat.viewer.server import Viewer
from helpers.captures import write_colmap
from helpers.engines import noted_engine
from viewer.test_browsers import browser
from viewer.test_viewer import browser_camera, make_soup


@pytest.fixture
def run(tmp_path: Path) -> SoupRun:
    write_colmap(tmp_path / "scene", [(32, 24)] * 5)
    return SoupRun(tmp_path / "soup.safetensors", make_soup(40), load_dataset(tmp_path / "scene", preload=False))


@pytest.fixture
def viewer(run: SoupRun) -> Iterator[Viewer]:
    pytest.importorskip("viser")
    shown = Viewer(run, "localhost", 0, 64)
    yield shown
    shown.close()


def client_at(run: SoupRun, index: int) -> Any:
    """A browser that looks from a photo, and keeps the files that it is sent."""
    assert run.capture is not None
    files: list[tuple[str, bytes]] = []

    def take(name: str, content: bytes, **_: Any) -> None:
        files.append((name, content))

    return SimpleNamespace(client_id=7, camera=browser_camera(run.capture, index), send_file_download=take, files=files)


def soon(done: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not done():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_crop_shows_the_triangles_within(viewer: Viewer, run: SoupRun) -> None:
    """The text names the part as the command line does; everything comes back."""
    panel = viewer._panel
    assert panel.crop is None
    panel._reach[0].value = 0.3
    panel._kind.value = "sphere"
    soon(lambda: len(viewer.soup) < 40)
    crop = panel.crop
    assert crop is not None
    assert len(viewer.soup) == int(crop.holds(run.soup.vertices.mean(dim=1)).sum())
    soon(lambda: panel._crop_text.content == f"`{crop}`")
    panel._kind.value = "everything"
    soon(lambda: len(viewer.soup) == 40)


@pytest.mark.parametrize("odd", [math.nan, math.inf, -1.0, 0.0])
def test_a_crop_that_is_none_keeps_everything(viewer: Viewer, odd: float) -> None:
    """A browser may say anything."""
    viewer._panel._reach[0]._impl.value = odd
    viewer._panel._kind._impl.value = "box"
    assert viewer._panel.crop is None


@pytest.mark.parametrize("mode", MODES)
def test_where_a_crop_leaves_nothing_the_background_is_drawn(run: SoupRun, mode: Any) -> None:
    nothing = cropped(run.soup, Sphere((100.0, 0.0, 0.0), 1.0))
    assert len(nothing) == 0
    assert run.capture is not None
    assert int(picture(nothing, run.capture.cameras[1], mode).max()) == 0


def test_a_photo_stands_beside_what_is_drawn_from_there(viewer: Viewer, run: SoupRun) -> None:
    """In the same shape and at the same size, so that they can be compared."""
    assert run.capture is not None
    camera = run.capture.cameras[2]
    wide = Cameras(camera.viewmats, torch.tensor([[[64.0, 0, 64], [0, 32.0, 12], [0, 0, 1]]]), 128, 24)
    both = beside_photo(run.soup, wide, "soft", run.capture, 2)
    assert both.shape == (24, 128, 3)
    assert float((both[:, 16:48].float() - run.capture.images[2].float()).abs().mean()) < 2
    assert torch.equal(both[:, 80:112], picture(run.soup, camera, "soft"))
    moved = camera.viewmats.clone()
    moved[0, 0, 3] += 0.3
    beside = beside_photo(run.soup, Cameras(moved, wide.Ks, 128, 24), "soft", run.capture, 2)
    centred = Cameras(moved, torch.tensor([[[32.0, 0, 16], [0, 32.0, 12], [0, 0, 1]]]), 32, 24)
    assert torch.equal(beside[:, 80:112], picture(run.soup, centred, "soft"))
    assert not viewer._panel.beside
    assert torch.equal(viewer.drawn(camera), picture(run.soup, camera, "soft"))
    viewer._panel._beside.value = True
    assert torch.equal(viewer.drawn(wide), both)


def test_cameras_are_kept_near_the_photos_until_that_is_switched_off(viewer: Viewer, run: SoupRun) -> None:
    assert run.capture is not None
    far = run.capture.cameras[1].viewmats.clone()
    far[0, 2, 3] += 40
    camera = Cameras(far, run.capture.cameras[1].Ks, 32, 24)
    assert float(viewer.kept(camera).centers.norm()) < 10
    viewer._panel._near.value = False
    assert viewer.kept(camera) is camera


def test_a_browser_begins_at_the_middle_photo(viewer: Viewer, run: SoupRun, monkeypatch: Any) -> None:
    went: list[int] = []
    monkeypatch.setattr("etsplat.viewer.server.stand_at", lambda client, capture, index: went.append(index))
    monkeypatch.setattr("etsplat.viewer.server._Client", lambda *_: SimpleNamespace(close=lambda: None))
    viewer._connected(SimpleNamespace(client_id=7))
    assert run.capture is not None
    assert went == [middle_photo(run.capture)]


def test_a_film_is_recorded_and_saved_as_a_path_that_render_plays(viewer: Viewer, run: SoupRun, tmp_path: Path) -> None:
    for index in (1, 2, 3):
        viewer._film(client := client_at(run, index), "add")
    viewer._film(client, "drop")
    assert viewer._panel.keys.content == "2 poses"
    viewer._film(client, "save")
    ((name, content),) = client.files
    (tmp_path / name).write_bytes(content)
    keys = read_camera_path(tmp_path / name)
    assert run.capture is not None
    torch.testing.assert_close(keys.viewmats, run.capture.viewmats[[1, 2]], atol=1e-5, rtol=0)
    assert json.loads(content)["aspect"] == pytest.approx(32 / 24)
    viewer._disconnected(7)
    viewer._film(client, "save")  # of a browser that has gone
    assert len(client.files) == 1


def test_a_snapshot_is_the_picture_as_a_file(viewer: Viewer, run: SoupRun) -> None:
    viewer._snapshot(client := client_at(run, 1))
    ((name, content),) = client.files
    assert name == "snapshot.png"
    assert Image.open(io.BytesIO(content)).size == (64, 48)


def test_who_says_no_camera_gets_no_files(viewer: Viewer) -> None:
    odd = SimpleNamespace(client_id=9, camera=browser(image_height=0))
    for who in (None, odd):
        viewer._snapshot(who)
        for what in ("add", "drop", "save"):
            viewer._film(who, what)
    assert 9 not in viewer._keys


def test_the_engine_of_the_run_draws(run: SoupRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever thread asks for a picture, as each browser has one."""
    pytest.importorskip("viser")
    noted = noted_engine(monkeypatch)
    viewer = Viewer(replace(run, engine="noted"), "localhost", 0, 64)
    assert run.capture is not None
    camera, drawn = run.capture.cameras[0], []
    thread = threading.Thread(target=lambda: drawn.append(viewer.drawn(camera)))
    thread.start()
    thread.join(30)
    viewer.close()
    assert noted.pictures == 1
    assert torch.equal(drawn[0], picture(run.soup, camera, "soft"))
