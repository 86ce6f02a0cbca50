"""No browser can end its own pictures, take the server's memory, or leave a thread behind."""

import math
import socket
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.opened_runs import SoupRun
from etsplat.viewer import server
from etsplat.viewer.follow import Followed
from etsplat.viewer.server import MOST_PIXELS, TALLEST, Viewer, camera_of
from viewer.test_viewer import make_soup

NAN, INF = math.nan, math.inf


class Camera(SimpleNamespace):
    """What viser says of a browser's camera; `aspect` as it computes it."""

    @property
    def aspect(self) -> float:
        return float(self.image_width) / self.image_height

    def on_update(self, _: Any) -> None:
        pass


def browser(**told: Any) -> Camera:
    usual = {"wxyz": np.array([1.0, 0, 0, 0]), "position": np.array([0.0, 0, -3]), "fov": 0.8}
    return Camera(**{**usual, "image_width": 640, "image_height": 480, **told})


ODD = [
    {"image_height": 0},
    {"image_width": 0},
    {"image_width": -5},
    {"image_width": NAN},
    {"image_height": "x"},
    {"fov": 0.0},
    {"fov": -1.0},
    {"fov": NAN},
    {"fov": 9.0},
    {"fov": 1e-300},
    {"fov": "x"},
    {"position": np.array([NAN, 0, 0])},
    {"position": np.array([0, INF, 0])},
    {"position": np.array([1e308, 0, 0])},
    {"position": np.array([0.0, 0])},
    {"position": np.array("x")},
    {"wxyz": np.zeros(4)},
    {"wxyz": np.array([NAN, 0, 0, 0])},
    {"wxyz": np.array([1.0, 0, 0])},
]


@pytest.mark.parametrize("odd", ODD, ids=str)
def test_an_odd_camera_is_not_drawn(odd: dict[str, Any]) -> None:
    assert camera_of(browser(**odd), 960) is None
    assert camera_of(browser(), 960) is not None


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(server, "STILL_AFTER", 0.01)
    camera, drawn = browser(), threading.Event()
    page = SimpleNamespace(camera=camera, scene=SimpleNamespace(set_background_image=lambda *_, **__: drawn.set()))
    soup = make_soup(4)
    viewer: Any = SimpleNamespace(kept=lambda camera: camera, drawn=lambda camera: server.picture(soup, camera, "soft"))
    drawing = server._Client(viewer, page, 32)
    yield SimpleNamespace(camera=camera, drawn=drawn, redraw=drawing.redraw)
    drawing.close()
    drawing.worker.join(10)
    assert not drawing.worker.is_alive()


def test_after_an_odd_camera_a_good_one_is_drawn(client: Any) -> None:
    assert client.drawn.wait(10)
    for odd in ODD[::3]:
        for name, value in odd.items():
            before = getattr(client.camera, name)
            setattr(client.camera, name, value)
            client.redraw()
            time.sleep(0.05)
            client.drawn.clear()
            setattr(client.camera, name, before)
            client.redraw()
            assert client.drawn.wait(10)


def test_after_a_picture_that_failed_the_next_is_drawn(
    client: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Why it failed is told once, not with every motion."""
    draw, failed = server.picture, threading.Semaphore(0)

    def fail(*_: Any) -> Any:
        failed.release()
        raise RuntimeError("no memory")

    monkeypatch.setattr(server, "picture", fail)
    for _ in range(3):
        client.redraw()
        assert failed.acquire(timeout=10)
    monkeypatch.setattr(server, "picture", draw)
    client.drawn.clear()
    client.redraw()
    assert client.drawn.wait(10)
    assert capsys.readouterr().err.count("RuntimeError: no memory") == 1


@pytest.mark.parametrize("width", [960, 8192])
def test_no_window_makes_a_large_picture(width: int) -> None:
    """However tall it is; those of usual shapes have the width that was asked for."""
    for height in (480, 640, 2560):
        camera = camera_of(browser(image_height=height), width)
        assert camera is not None
        assert camera.width == width or width * width * height / 640 > MOST_PIXELS
    for height in (641, 6400, 10**6, 10**10):
        camera = camera_of(browser(image_height=height), width)
        assert camera is not None
        assert camera.width * camera.height <= min(TALLEST * width**2, MOST_PIXELS)


@pytest.fixture
def viewer(tmp_path: Any) -> Any:
    pytest.importorskip("viser")
    shown = Viewer(SoupRun(tmp_path / "soup.safetensors", make_soup(4), None), "localhost", 0, 32)
    yield shown
    shown.close()


def test_a_browser_that_has_gone_before_it_was_welcomed_leaves_no_thread(viewer: Viewer) -> None:
    """viser calls what is registered for connecting in a pool, and often after what is for disconnecting."""
    before = threading.active_count()
    scene = SimpleNamespace(set_background_image=lambda *_, **__: None)
    gone = SimpleNamespace(client_id=7, atomic=threading.Lock, camera=browser(), scene=scene)
    viewer._disconnected(7)
    viewer._connected(gone)
    assert not viewer._clients
    ends_within(10, lambda: threading.active_count() <= before)


def test_short_visits_leave_no_thread(viewer: Viewer) -> None:
    """Through a websocket, as browsers come and go."""
    import msgspec
    import viser
    from websockets.sync.client import connect

    told = {"wxyz": [1.0, 0, 0, 0], "position": [0.0, 0, -3], "look_at": [0.0, 0, 0], "up_direction": [0.0, 1, 0]}
    told |= {"fov": 0.8, "near": 0.01, "far": 100.0, "image_height": 48, "image_width": 64}
    message = msgspec.msgpack.encode({"type": "ViewerCameraMessage", **told})
    for visit in range(10):
        websocket = connect(
            f"ws://localhost:{viewer.port}/",
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            sock=socket.create_connection(("localhost", viewer.port), timeout=10),
            compression=None,
        )
        websocket.send(message)
        time.sleep(0.01 * (visit % 4))
        websocket.socket.shutdown(socket.SHUT_RDWR)
    ends_within(20, lambda: not viewer._clients and not [t for t in threading.enumerate() if "_work" in t.name])


def ends_within(seconds: float, done: Any) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, [thread.name for thread in threading.enumerate()]
        time.sleep(0.05)


def test_a_viewer_that_is_closed_draws_no_more(viewer: Viewer) -> None:
    camera = browser()
    scene = SimpleNamespace(set_background_image=lambda *_, **__: None)
    client = SimpleNamespace(client_id=7, atomic=threading.Lock, camera=camera, scene=scene)
    viewer.server.get_clients = lambda: {7: client}  # type: ignore[method-assign, assignment]
    viewer._connected(client)
    worker = viewer._clients[7].worker
    assert worker.is_alive()
    viewer.close()
    assert not worker.is_alive()
    viewer._connected(client)  # by a thread of viser's that was late
    assert not viewer._clients or not viewer._clients[7].worker.is_alive()


def test_a_run_that_is_started_anew_is_followed_on(tmp_path: Any) -> None:
    """Files are missing for a moment where a run replaces another."""
    run = RunDirectory.create(tmp_path / "run", {"task": "train", "iterations": 100, "config": {}})
    make_soup(3).save(run.soup_path)
    run.append_history({"iteration": 50, "seconds": 1.0, "loss": 0.1})
    followed = Followed(run.path, torch.device("cpu"))
    status = followed.status()
    assert status == "running: iteration 50 of 100"
    for name in ("config.json", "history.jsonl"):
        (run.path / name).rename(tmp_path / name)
        assert followed.status() == ""
        (tmp_path / name).rename(run.path / name)
        assert followed.status() == status
