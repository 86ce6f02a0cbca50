"""No browser can end its own pictures, take the server's memory, or leave a thread behind."""

import threading
import time
from types import SimpleNamespace

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.soup_run import SoupRun
from etsplat.viewer import server
from etsplat.viewer.follow import Followed
from etsplat.viewer.server import Viewer, camera_of
from viewer.test_viewer import make_soup


def browser(aspect=4 / 3, fov=0.8):
    return SimpleNamespace(wxyz=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, -3.0), aspect=aspect, fov=fov)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("bad", [{"aspect": float("nan")}, {"aspect": 0.0}, {"fov": 0.0}, {"fov": float("nan")}])
@pytest.mark.xfail(strict=True, raises=AssertionError, reason="row 4: an odd camera ends that tab's drawing for good")
def test_after_an_odd_camera_a_good_one_is_drawn(bad, monkeypatch):
    drawn = threading.Event()
    monkeypatch.setattr(server, "STILL_AFTER", 0.01)
    camera = browser(**bad)
    camera.on_update = lambda call: None
    scene = SimpleNamespace(set_background_image=lambda *_, **__: drawn.set())
    viewer = SimpleNamespace(soup=make_soup(4), mode="soft")
    before = set(threading.enumerate())
    client = server._Client(viewer, SimpleNamespace(camera=camera, scene=scene), 32)
    (worker,) = set(threading.enumerate()) - before
    worker.join(0.3)  # it draws, or dies
    drawn.clear()
    camera.aspect, camera.fov = 4 / 3, 0.8
    client.redraw()
    came = drawn.wait(2) if worker.is_alive() else False
    client.close()
    assert came


@pytest.mark.xfail(strict=True, raises=AssertionError, reason="row 4: a tall browser takes gigabytes")
def test_a_tall_browser_gets_a_small_picture():
    camera = camera_of(browser(aspect=1e-5), 960)
    assert camera.width * camera.height <= 64 << 20


@pytest.mark.xfail(strict=True, raises=AssertionError, reason="row 4: threads stay behind after short visits")
def test_a_browser_that_has_gone_before_it_was_welcomed_leaves_no_thread(tmp_path):
    """viser calls what is registered for connecting in a pool, and often after what is for disconnecting."""
    pytest.importorskip("viser")
    viewer = Viewer(SoupRun(tmp_path / "soup.safetensors", make_soup(4), None), "localhost", 0, 32)
    try:
        gone = SimpleNamespace(client_id=7, atomic=threading.Lock, camera=browser(), scene=None)
        gone.camera.on_update = lambda call: None
        gone.scene = SimpleNamespace(set_background_image=lambda *_, **__: None)
        viewer._disconnected(7)
        viewer._connected(gone)
        assert not viewer._clients
    finally:
        viewer.close()


@pytest.mark.xfail(strict=True, raises=InputError, reason="row 4: the page stops following if a file is missing once")
def test_a_run_that_is_started_anew_is_followed_on(tmp_path):
    run = RunDirectory.create(tmp_path / "run", {"task": "train", "iterations": 100, "config": {}})
    make_soup(3).save(run.soup_path)
    run.append_history({"iteration": 50, "seconds": 1.0, "loss": 0.1})
    followed = Followed(run.path, torch.device("cpu"))
    assert followed.status()
    (run.path / "config.json").rename(tmp_path / "config.json")
    assert followed.status() == ""
    time.sleep(0)
    (tmp_path / "config.json").rename(run.path / "config.json")
    assert followed.status()
