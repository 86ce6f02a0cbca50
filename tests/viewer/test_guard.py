"""The viewer answers to its own page, opened by its own address, and to nobody else."""

import http.client
import socket
import threading

import pytest

from etsplat.tasks.opened_runs import SoupRun
from etsplat.viewer.guard import Guard
from etsplat.viewer.server import Viewer
from viewer.test_viewer import make_soup

viser = pytest.importorskip("viser")
PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture
def viewer(tmp_path):
    shown = Viewer(SoupRun(tmp_path / "soup.safetensors", make_soup(4), None), "localhost", 0, 64)
    yield shown
    shown.close()


def connect(viewer, host, origin):
    """A websocket as a browser opens it whose bar shows `host`, from a page of `origin`."""
    from websockets.sync.client import connect as open_websocket

    return open_websocket(
        f"ws://{host}:{viewer.port}/",
        origin=origin,
        subprotocols=[PROTOCOL],
        sock=socket.create_connection(("localhost", viewer.port), timeout=10),
        compression=None,
        max_size=None,
    )


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "LOCALHOST"])
def test_the_own_page_gets_through(viewer, host):
    with connect(viewer, host, f"http://{host}:{viewer.port}") as websocket:
        assert len(websocket.recv(timeout=20)) > 0


def test_a_program_that_is_no_browser_gets_through(viewer):
    with connect(viewer, "localhost", None) as websocket:
        assert len(websocket.recv(timeout=20)) > 0


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("localhost", "http://evil.example"),
        ("localhost", "https://localhost.evil.example"),
        ("localhost", "http://localhost:1"),  # another server on this machine
        ("localhost", "http://localhost"),
        ("localhost", "null"),
        ("evil.example", "http://evil.example:{port}"),  # DNS rebinding
        ("evil.example", None),
        ("192.0.2.7", None),
    ],
)
def test_a_strangers_page_is_refused(viewer, host, origin):
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus) as caught, connect(viewer, host, origin and origin.format(port=viewer.port)):
        pass
    assert caught.value.response.status_code == 403
    assert b"this viewer" in caught.value.response.body


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ([("Host", "localhost:{port}")], 200),
        ([("Host", "evil.example")], 403),
        ([("Host", "localhost:{port}"), ("Host", "evil.example")], 403),
        ([("Host", "[::1")], 403),
        ([], 403),
        ([("Host", "localhost:{port}"), ("Origin", "http://evil.example")], 403),
    ],
)
def test_the_page_itself_is_served_to_those_alone(viewer, headers, status):
    connection = http.client.HTTPConnection("localhost", viewer.port, timeout=20)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in headers:
        connection.putheader(name, value.format(port=viewer.port))
    connection.endheaders()
    response = connection.getresponse()
    assert response.status == status
    assert (b"<html" in response.read().lower()) == (status == 200)
    assert response.headers["Content-Security-Policy"] == ("frame-ancestors 'self'" if status == 200 else None)


def test_listening_everywhere_any_address_leads_here_but_no_name():
    guard = Guard("0.0.0.0")
    for host in ("192.0.2.7:8080", "[2001:db8::1]:8080", "localhost:9000", socket.gethostname()):
        assert guard.refusal([host], [f"http://{host}"]) is None
    assert guard.refusal(["evil.example:8080"], []) is not None
    assert Guard("box.lan").refusal(["box.lan:8080"], ["http://box.lan:8080"]) is None


def test_a_viser_that_starts_unguarded_is_noticed():
    with pytest.raises(RuntimeError, match="cannot guard it"), Guard("localhost").installed():
        pass


def test_a_page_that_asks_for_a_public_tunnel_gets_none(viewer, monkeypatch):
    import msgspec
    from viser import _viser

    opened, asked = [], threading.Event()
    monkeypatch.setattr(_viser, "ViserTunnel", lambda *arguments: opened.append(arguments))
    viewer.server.request_share_url()
    assert opened == []
    monkeypatch.setattr(viewer.server, "request_share_url", asked.set)
    with connect(viewer, "localhost", f"http://localhost:{viewer.port}") as websocket:
        websocket.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        assert asked.wait(20)  # it is this that viser calls
