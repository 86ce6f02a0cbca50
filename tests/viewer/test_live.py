"""A run that is watched while it goes on: served from memory, at little cost, and the same run to the bit."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import StepEvent
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from etsplat.viewer import live
from etsplat.viewer.live import LiveView
from viewer.test_browsers import browser
from viewer.test_viewer import make_soup

pytest.importorskip("viser")

TINY = TrainConfig.tiny().changed({"iterations": 30, "output.log_every": 10, "max_triangles": 600})


@pytest.fixture(scope="module")
def capture() -> Dataset:
    scene = demo_scene(32, 24)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    return replace(scene, exact_points=scene.exact_points[::40], point_colors=scene.point_colors[::40])


@pytest.fixture
def watching(tmp_path: Path) -> Iterator[LiveView]:
    ports: list[int] = []
    with LiveView(tmp_path / "run", "localhost", 0, 32, ports.append) as view:
        view.ports = ports  # type: ignore[attr-defined]
        yield view


def look_in(view: LiveView) -> Any:
    """A browser that opens the page; `pictures` has what it is sent."""
    viewer = view._viewer
    assert viewer is not None
    pictures: list[Any] = []
    scene = SimpleNamespace(set_background_image=lambda picture, **_: pictures.append(picture))
    client = SimpleNamespace(client_id=7, atomic=lambda: viewer.server.atomic(), camera=browser(), scene=scene)
    client.pictures = pictures
    viewer.server.get_clients = lambda: {7: client}  # type: ignore[method-assign, assignment]
    viewer._connected(client)
    return client


def soon(done: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not done():
        assert time.monotonic() < end
        time.sleep(0.02)


def status(view: LiveView) -> str:
    assert view._viewer is not None
    return view._viewer._panel.status.content


def test_a_run_that_is_watched_ends_with_the_same_bits(
    capture: Dataset, tmp_path: Path, watching: LiveView, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser that gets every soup, drawn by another thread; copies that are taken and written over."""
    monkeypatch.setattr(live, "LEAST_SECONDS", 0.0)
    monkeypatch.setattr(live, "SHARE", 1e9)
    monkeypatch.setattr(live, "DRAWING_SHARE", 1e9)
    seen: list[int] = []
    clients: list[Any] = []

    def look(own: Dataset, iteration: int, soup: Callable[[], TriangleSoup]) -> None:
        def taken() -> TriangleSoup:
            seen.append(iteration)
            soup().vertices.fill_(7.0)  # a copy of its own
            return soup()

        watching.look(own, iteration, taken)
        if not clients:
            clients.append(look_in(watching))

    watched = train(capture, tmp_path / "watched", TINY, callbacks=[watching], onlooker=look)
    alone = train(capture, tmp_path / "alone", TINY, callbacks=[lambda _: None])
    for name, tensor in alone.soup.state().items():
        assert torch.equal(tensor, watched.soup.state()[name]), name
    for name in ("history.jsonl", "metrics.json"):
        assert (tmp_path / "watched" / name).exists()
    assert seen == list(range(31))
    soon(lambda: len(clients[0].pictures) > 1)
    watching.finish(watched.soup)
    assert status(watching).startswith(f"{len(watched.soup):,} triangles after 30 iterations")
    assert "finished: iteration 30 of 30, " in status(watching)
    assert " dB on test views" in status(watching)


def test_soups_are_taken_while_somebody_looks_and_seldom_enough(
    capture: Dataset, watching: LiveView, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first at once; then not before a browser looks, and a copy that took a while not again for a hundred."""
    now, taken = [1000.0], []
    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])

    def soup() -> TriangleSoup:
        taken.append(now[0])
        now[0] += 0.05
        return make_soup(4)

    watching.look(capture, 0, soup)
    assert watching.ports  # type: ignore[attr-defined]
    for _ in range(100):
        now[0] += 1.0
        watching.look(capture, 1, soup)
    assert len(taken) == 1
    monkeypatch.setattr(type(watching._viewer), "watched", True)
    for _ in range(100):
        now[0] += 0.5
        watching.look(capture, 1, soup)
    steps = [after - before for before, after in pairwise(taken[1:])]
    assert len(taken) > 8
    assert min(steps) >= 5.0
    monkeypatch.setattr(type(watching._viewer), "watched", False)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (KeyboardInterrupt(), "interrupted (after iteration 20 of 100, 21.50 dB on test views)"),
        (RuntimeError("the disk is full"), "failed: the disk is full (after iteration 20 of 100, "),
    ],
)
def test_it_says_how_a_run_ended_early(
    capture: Dataset, watching: LiveView, error: BaseException, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "_PARTING_SECONDS", 0.01)
    watching.look(capture, 0, lambda: make_soup(4))
    for iteration, metrics in ((10, {"psnr": 21.5}), (20, {})):
        watching(StepEvent(iteration, 100, 1.0, 0.1, {}, metrics))
    assert "running: iteration 20 of 100, 21.50 dB" in status(watching)
    watching.__exit__(type(error), error, None)
    assert text in status(watching)


def test_an_address_that_cannot_be_used_is_told_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot listen there"):
        LiveView(tmp_path, "192.0.2.1", 8080, 64, lambda _: None)
    with pytest.raises(InputError, match="view-port: is 70000"):
        parse(["train", str(tmp_path), "--out", str(tmp_path / "run"), "--view", "--view-port", "70000"]).run([])


def test_a_run_nobody_looks_at_ends_when_it_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the command line, where the page is named, and it goes on only while a browser looks."""
    monkeypatch.chdir(tmp_path)
    words = ["demo", "scene", "--preset", "tiny", "--iterations", "5", "--out", "run", "--view", "--view-port", "8951"]
    assert parse(words).run(words) == 0
    written = capsys.readouterr().out
    assert "watch it at http://localhost:8951" in written
    assert "stays open" not in written
