import math
import os
import socket
import threading
import urllib.request
from types import SimpleNamespace

import pytest
import torch

from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.viewer import follow, server, standing
from etsplat.viewer.follow import Followed, wait_for_soup
from etsplat.viewer.pace import SMALLEST, Pace
from etsplat.viewer.pictures import MODES, picture
from etsplat.viewer.server import Viewer, camera_of
from helpers.captures import write_colmap


def make_soup(count, seed=0):
    rng = torch.Generator().manual_seed(seed)
    return TriangleSoup.from_triangles(
        torch.randn(count, 1, 3, generator=rng) * 0.3 + torch.randn(count, 3, 3, generator=rng) * 0.3,
        torch.rand(count, 3, generator=rng),
        opacity=0.9,
        sigma=0.3,
        sh_degree=1,
    )


@pytest.fixture
def run(tmp_path):
    write_colmap(tmp_path / "scene", [(32, 24)] * 4)
    return SoupRun(tmp_path / "soup.safetensors", make_soup(40), load_dataset(tmp_path / "scene", preload=False))


def browser_camera(capture, index):
    """A camera as viser tells it: camera to world as a quaternion (w, x, y, z) and a position."""
    width, height = capture.images.sizes[index]
    return SimpleNamespace(
        wxyz=standing.quaternion(capture.viewmats[index, :3, :3].T),
        position=capture.centers[index].numpy(),
        fov=2 * math.atan(height / (2 * float(capture.Ks[index, 1, 1]))),
        aspect=width / height,
    )


def test_a_browsers_camera_is_the_captures_camera(run):
    camera = camera_of(browser_camera(run.capture, 2), 64)
    assert (camera.width, camera.height) == (64, 48)
    torch.testing.assert_close(camera.viewmats, run.capture.cameras[2].viewmats, atol=1e-5, rtol=0)
    torch.testing.assert_close(camera.Ks[0, 1, 1], 2 * run.capture.cameras[2].Ks[0, 1, 1])


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_shows_something_else(run, mode):
    shown = {name: picture(run.soup, run.capture.cameras[1], name) for name in MODES}
    assert shown[mode].dtype == torch.uint8
    assert shown[mode].shape == (24, 32, 3)
    assert float(shown[mode].float().mean()) > 5
    assert all(not torch.equal(shown[mode], other) for name, other in shown.items() if name != mode)


def test_pictures_shrink_until_moving_is_fluent_and_grow_back():
    pace = Pace(960, 0.08)
    for _ in range(20):
        pace.took(1e-6 * pace.width**2)  # 0.1 s at a width of 320
    assert pace.width == pytest.approx(math.sqrt(0.08 / 1e-6), rel=0.02)
    for _ in range(20):
        pace.took(10.0)
    assert pace.width == SMALLEST
    for _ in range(20):
        pace.took(1e-4)
    assert pace.width == 960


def test_a_run_is_followed_through_its_files(tmp_path):
    folder = RunDirectory.create(tmp_path / "run", {"task": "train", "iterations": 100, "config": {}})
    followed = Followed(folder.path, torch.device("cpu"))
    assert followed.poll() is None
    assert followed.status() == ""
    make_soup(3).save(folder.soup_path)
    assert len(followed.poll()) == 3
    assert followed.poll() is None
    make_soup(5).save(folder.soup_path)
    assert len(followed.poll()) == 5
    folder.append_history({"iteration": 50, "seconds": 1.0, "loss": 0.1, "psnr": 21.5})
    reached = "iteration 50 of 100, 21.50 dB on test views"
    assert followed.status() == f"running: {reached}"
    folder.write_end("failed: the disk is full")
    assert followed.status() == f"failed: the disk is full (after {reached})"
    folder.forget_end()
    (folder.path / ".lock").write_text(f"process {os.getpid()} on {socket.gethostname()}")
    assert followed.status() == f"running: {reached}"
    (folder.path / ".lock").write_text(f"process {2**22 + 1} on {socket.gethostname()}")  # beyond what Linux numbers
    assert followed.status() == f"killed (after {reached})"
    for nobody in (f"process {2**22 + 1} on elsewhere", "process", ""):
        (folder.path / ".lock").write_text(nobody)
        assert followed.status() == f"running: {reached}"
    folder.write_metrics({})
    assert followed.status() == f"finished: {reached}"
    folder.soup_path.unlink()
    assert followed.poll() is None


def test_a_run_that_is_about_to_begin_is_waited_for(tmp_path, monkeypatch):
    """The run appears in its folder, then its first soup: told what is waited for, once each."""
    path, steps, told = tmp_path / "run", [], []
    path.mkdir()

    def happen(_):
        steps.append(None)
        if len(steps) == 2:
            RunDirectory.create(path, {"task": "train", "iterations": 100, "config": {}})
        if len(steps) == 3:
            RunDirectory(path).write_end("failed: no memory")
        if len(steps) == 4:
            make_soup(3).save(path / "soup.safetensors")

    monkeypatch.setattr(follow.time, "sleep", happen)
    wait_for_soup(path, told.append)
    assert len(steps) == 4
    assert told.pop() == f"{path}: failed: no memory; waiting for it to go on"
    waited = [text.split("waiting for ")[1] for text in told]
    assert waited == ["`etsplat train` to begin there", "the first checkpoint"]
    old = RunDirectory.create(tmp_path / "old", {"task": "train", "config": {}})
    make_soup(3).save(old.soup_path)
    with pytest.raises(InputError, match=r"old/config\.json: an earlier version .* lacks `iterations`; remove the"):
        wait_for_soup(old.path, told.append)
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("dear")
    with pytest.raises(InputError, match="is not a run"):
        wait_for_soup(tmp_path / "letters", told.append)
    RunDirectory.create(tmp_path / "mesh", {"task": "reconstruct", "config": {}})
    with pytest.raises(InputError, match=r"mesh\.glb opens in any mesh viewer"):
        wait_for_soup(tmp_path / "mesh", told.append)
    (tmp_path / "empty").mkdir()
    monkeypatch.setattr(follow.time, "sleep", lambda _: (tmp_path / "empty").rmdir())
    with pytest.raises(InputError, match="empty: has gone"):
        wait_for_soup(tmp_path / "empty", told.append)


def test_a_folder_that_is_not_there_is_waited_for_on_request(tmp_path, monkeypatch, capsys):
    """Ctrl-C ends that without a word; without the request, a mistyped name is answered with the one that was meant."""
    (tmp_path / "kitchen").mkdir()
    for name, remedy in (("kitchne", r"did you mean .*kitchen\?"), ("garden", "check the path")):
        with pytest.raises(InputError, match=rf"{name}: .* folder; {remedy} \(or --wait for a run to begin there\)"):
            parse(["view", str(tmp_path / name)]).run([])

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(follow.time, "sleep", interrupt)
    for name in ("garden", "kitchen"):
        assert parse(["view", str(tmp_path / name), "--wait"]).run([]) == 0
        written = capsys.readouterr().out
        assert written == f"{tmp_path / name}: waiting for `etsplat train` to begin there (Ctrl-C ends it)\n"


def test_the_page_is_served_on_localhost(run):
    pytest.importorskip("viser")
    viewer = Viewer(run, "localhost", 8931, 64)
    try:
        with urllib.request.urlopen(f"http://localhost:{viewer.port}", timeout=10) as response:
            assert b"<html" in response.read().lower()
        assert viewer.server.get_host() == "localhost"
    finally:
        viewer.close()


def test_an_address_that_is_not_ones_own_is_an_input_error(run):
    """viser would wait for ever: it listens in a thread, which ends with a traceback."""
    pytest.importorskip("viser")
    with pytest.raises(InputError, match=r'host="192\.0\.2\.1" port=8933: cannot listen there'):
        Viewer(run, "192.0.2.1", 8933, 64)  # of a network for documentation


def test_a_browser_that_is_closed_while_its_picture_is_drawn_gets_none(run):
    """One thread, which ends; a picture for nobody would be a warning of viser's on the terminal."""
    sent, drawing, closed = [], threading.Event(), threading.Event()

    def draw(*_):
        drawing.set()
        assert closed.wait(10)
        return torch.zeros(2, 2, 3, dtype=torch.uint8)

    camera = browser_camera(run.capture, 0)
    camera.on_update = lambda call: None
    scene = SimpleNamespace(set_background_image=lambda *arguments, **options: sent.append(arguments))
    before = set(threading.enumerate())
    viewer = SimpleNamespace(kept=lambda camera: camera, drawn=draw)
    client = server._Client(viewer, SimpleNamespace(camera=camera, scene=scene), 64)
    (worker,) = set(threading.enumerate()) - before
    assert drawing.wait(10)
    client.close()
    closed.set()
    worker.join(10)
    assert not worker.is_alive()
    assert sent == []


def test_without_viser_the_extra_is_named(run, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(InputError, match=r"etsplat\[viewer\]"):
        Viewer(run, "localhost", 8932, 64)
