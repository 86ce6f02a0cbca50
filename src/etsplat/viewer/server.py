"""The web server of the viewer: viser (an extra) draws the page, our engine the pictures.

Every browser has a thread of its own that waits for its camera to move. It draws small pictures while it moves, at the
width that `Pace` allows, and one of full width as soon as it stands still.
"""

import contextlib
import errno
import io
import math
import socket
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics
from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.data.looked_at import middle_photo
from etsplat.data.where_up import up_of
from etsplat.engines.choice import engine
from etsplat.io.camera_path_files import KeyPoses
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.viewer.follow import Followed
from etsplat.viewer.guard import Guard
from etsplat.viewer.pace import Pace
from etsplat.viewer.panel import Panel
from etsplat.viewer.pictures import beside_photo, cropped, picture, png_of
from etsplat.viewer.standing import (
    Neighbourhood,
    add_frusta,
    nearest_photo,
    stand_at,
    stand_before,
)

MOVING_SECONDS = 0.08
"""What a picture may take while the camera moves."""

STILL_AFTER = 0.2
"""Seconds without motion after which the picture is sharpened."""

TALLEST, MOST_PIXELS = 4, 1 << 26
"""Of a picture: its height in widths, and how large it is at most. Those for narrower windows are less wide."""

POLL_SECONDS = 2.0
CLOSING_SECONDS = 5.0
"""For which pictures that are being drawn are waited for at the end."""

MOST_KEYS = 1000
"""Poses that a browser may add to its film."""


class Viewer:
    """Serves one soup; `close` ends it."""

    def __init__(self, run: SoupRun, host: str, port: int, width: int, *, follow: bool = True) -> None:
        """Starts the server.

        Args:
            run: what to show.
            host: address to listen on.
            port: to listen on; the next free one is taken if it is in use.
            width: of still pictures, at most.
            follow: show what a run directory has, as it changes. Without it, whoever made this calls `show` and `say`.

        Raises:
            InputError: viser is missing, or the address cannot be used.
        """
        server_class = check_can_serve(host, port)
        self._run, self._width = run, width
        self._soup = self._cropped = run.soup
        self._solid = self._cropped_solid = run.solid
        self._near = None if run.capture is None else Neighbourhood.of(run.capture)
        self._clients: dict[int, _Client] = {}
        self._keys: dict[int, list[tuple[Cameras, float]]] = {}
        self._closed = threading.Event()
        with Guard(host).installed(), _without_banner():
            self.server = server_class(host=host, port=port, verbose=False)
        self._build_page()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(lambda client: self._disconnected(client.client_id))
        if follow and run.path.is_dir():
            threading.Thread(target=self._follow, args=(Followed(run.path, run.device),), daemon=True).start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return self.server.get_port()

    @property
    def soup(self) -> TriangleSoup:
        """What is shown now: the opaque mesh, if there is one, where triangles are drawn opaque."""
        solid = self._cropped_solid if self.mode in ("opaque", "wireframe") else None
        return self._cropped if solid is None else solid

    @property
    def mode(self) -> Any:
        """The chosen mode."""
        return self._panel.mode

    @property
    def watched(self) -> bool:
        """Whether a browser looks."""
        return bool(self._clients)

    @property
    def seconds_to_draw(self) -> float:
        """What the last full picture of each browser took, together."""
        return sum(client.seconds for client in list(self._clients.values()))

    def show(self, soup: TriangleSoup) -> None:
        """Shows another soup from now on; what is drawn of it is drawn on its device."""
        self._soup, self._solid = soup, None
        self._refresh()

    def say(self, text: str) -> None:
        """Says how the run stands, below how many triangles there are."""
        self._panel.status.content = "\n\n".join(part for part in (_describe(self._soup), text) if part)

    def kept(self, camera: Cameras) -> Cameras:
        """The camera from which is drawn for a browser: its own, or the nearest one that is near photos."""
        return camera if self._near is None or not self._panel.near else self._near.kept(camera)

    def drawn(self, camera: Cameras) -> UInt8[Tensor, "H W 3"]:
        """The picture of a camera, with the photo nearest to it beside it if that is wanted."""
        with engine(self._run.engine):
            if self._run.capture is None or not self._panel.beside:
                return picture(self.soup, camera, self.mode)
            photo = nearest_photo(self._run.capture, camera)
            return beside_photo(self.soup, camera, self.mode, self._run.capture, photo)

    def close(self) -> None:
        """Ends the server and its threads."""
        self._closed.set()
        clients = list(self._clients.values())
        for client in clients:
            client.close()
        with _without_banner():
            self.server.stop()
        for client in clients:
            client.worker.join(CLOSING_SECONDS)

    def _build_page(self) -> None:
        self.server.gui.configure_theme(show_share_button=False)
        if hasattr(self.server.gui, "main_panel"):  # not in the oldest viser that works
            self.server.gui.main_panel.dock_right()  # beside the picture, not over it
        self._panel = panel = Panel(self.server.gui, self._run.capture, self._soup, self._refresh)
        self.say("")
        if (capture := self._run.capture) is not None:
            up = up_of(capture)
            if up is not None:
                self.server.scene.set_up_direction(tuple(up.tolist()))
            frusta = add_frusta(self.server, capture)

            def show_cameras(_: Any) -> None:
                for frustum in frusta:
                    frustum.visible = panel.show_cameras.value

            panel.show_cameras.on_update(show_cameras)
            panel.on_go(lambda client, index: stand_at(client, capture, index))
        panel.snapshot.on_click(lambda event: self._snapshot(event.client))
        panel.add_key.on_click(lambda event: self._film(event.client, "add"))
        panel.drop_key.on_click(lambda event: self._film(event.client, "drop"))
        panel.save_keys.on_click(lambda event: self._film(event.client, "save"))

    def _snapshot(self, client: Any) -> None:
        """Sends a browser its picture as a file."""
        if client is not None and (camera := camera_of(client.camera, self._width)) is not None:
            client.send_file_download("snapshot.png", png_of(self.drawn(self.kept(camera))), save_immediately=True)

    def _film(self, client: Any, what: str) -> None:
        """Adds a browser's pose to its film, takes the last one away, or sends the film as a file."""
        if client is None or (camera := camera_of(client.camera, self._width)) is None:
            return
        keys = self._keys.setdefault(client.client_id, [])
        if what == "add" and len(keys) < MOST_KEYS:
            keys.append((self.kept(camera), math.degrees(client.camera.fov)))
        elif what == "drop" and keys:
            keys.pop()
        elif what == "save" and keys:
            viewmats = torch.cat([key.viewmats for key, _ in keys]).double()
            fovs = torch.tensor([min(max(fov, 1.0), 170.0) for _, fov in keys], dtype=torch.float64)
            path = KeyPoses(viewmats, fovs, min(max(camera.width / camera.height, 0.05), 20.0))
            client.send_file_download("path.json", path.to_json().encode(), save_immediately=True)
        self._panel.keys.content = f"{len(keys)} poses" if len(keys) != 1 else "1 pose"

    def _connected(self, client: Any) -> None:
        if self._run.capture is not None:
            stand_at(client, self._run.capture, middle_photo(self._run.capture))
        else:
            stand_before(client, self._soup)
        self._clients[client.client_id] = _Client(self, client, self._width)
        # viser calls this in a thread, maybe after the browser has gone and `_disconnected` was called.
        if self._closed.is_set() or client.client_id not in self.server.get_clients():
            self._disconnected(client.client_id)

    def _disconnected(self, identity: int) -> None:
        self._keys.pop(identity, None)
        gone = self._clients.pop(identity, None)
        if gone is not None:
            gone.close()

    def _refresh(self) -> None:
        self._cropped = cropped(self._soup, self._panel.crop)
        self._cropped_solid = None if self._solid is None else cropped(self._solid, self._panel.crop)
        for client in list(self._clients.values()):
            client.redraw()

    def _follow(self, followed: Followed) -> None:
        while not self._closed.wait(POLL_SECONDS):
            soup = followed.poll()
            if soup is not None:
                self.show(soup)
            self.say(followed.status())


class _Client:
    """One browser: its thread draws whenever something changed."""

    def __init__(self, viewer: Viewer, client: Any, width: int) -> None:
        self._viewer, self._client = viewer, client
        self._pace = Pace(width, MOVING_SECONDS)
        self._changed = threading.Event()
        self._closed = self._failing = False
        self.seconds = 0.0
        client.camera.on_update(lambda _: self.redraw())
        self.worker = threading.Thread(target=self._work, daemon=True)
        self.worker.start()
        self.redraw()

    def redraw(self) -> None:
        """The camera moved, or what it sees changed."""
        self._changed.set()

    def close(self) -> None:
        """Ends the thread."""
        self._closed = True
        self._changed.set()

    def _work(self) -> None:
        while True:
            self._changed.wait()
            while self._changed.is_set() and not self._closed:
                self._changed.clear()
                start = time.perf_counter()
                self._draw(self._pace.width)
                self._pace.took(time.perf_counter() - start)
                self._changed.wait(STILL_AFTER)
            if self._closed:
                return
            self._come_back()
            start = time.perf_counter()
            self._draw(self._pace.full_width, quality=92)
            self.seconds = time.perf_counter() - start

    def _come_back(self) -> None:
        """Takes the browser's camera, now that it stands still, to where its pictures are drawn from."""
        camera = camera_of(self._client.camera, self._pace.full_width)
        if camera is None or (kept := self._viewer.kept(camera)) is camera:
            return
        self._client.camera.position = kept.centers[0].double().numpy()

    def _draw(self, width: int, quality: int = 70) -> None:
        camera = camera_of(self._client.camera, width)
        if camera is None:
            return
        try:
            pixels = self._viewer.drawn(self._viewer.kept(camera))
        except Exception:  # whatever it was, such as no memory for this soup: the next picture may come out
            if not self._failing:
                traceback.print_exc()
            self._failing = True
            return
        self._failing = False
        if self._closed:  # while it was drawn: viser would warn that nobody gets the picture
            return
        self._client.scene.set_background_image(pixels.numpy(), format="jpeg", jpeg_quality=quality)


def camera_of(camera: Any, width: int) -> Cameras | None:
    """The single camera of a browser, which may say anything; None if nothing can be drawn with it.

    Args:
        camera: `wxyz` and `position` camera to world, `fov` vertical in radians, `aspect`.
        width: of the picture, at most.
    """
    try:
        told = [float(number) for number in (*camera.wxyz, *camera.position, camera.fov, camera.aspect)]
        w, x, y, z, *position, fov, aspect = told
    except (TypeError, ValueError, ArithmeticError):  # viser divides by the height of the window
        return None
    turned = 0 < math.hypot(w, x, y, z) < math.inf
    if len(position) != 3 or not (turned and 0 < fov < math.pi and 1e-9 < aspect < 1e9):
        return None
    most = min(TALLEST * width**2, MOST_PIXELS)
    width = max(1, round(min(width, math.sqrt(most * aspect))))
    height = min(max(1, round(width / aspect)), most // width)
    rotation = torch.from_numpy(Rotation.from_quat([x, y, z, w]).as_matrix())
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ torch.tensor(position, dtype=torch.float64)
    viewmat, K = viewmat.float(), intrinsics(float(np.degrees(fov)), width, height)
    if not (viewmat.isfinite().all() and K.isfinite().all()):
        return None
    return Cameras(viewmat[None], K[None], width, height)


def serve(run: SoupRun, host: str, port: int, width: int, announce: Callable[[int], None]) -> None:
    """Serves until Ctrl-C; `announce` is told the port."""
    viewer = Viewer(run, host, port, width)
    announce(viewer.port)
    try:
        threading.Event().wait()
    finally:
        viewer.close()


def check_can_serve(host: str, port: int) -> Any:
    """Sees to it that a viewer can listen at an address, and gives the class of its server.

    Raises:
        InputError: viser is missing, or the address cannot be used.
    """
    found = _server_class()
    # viser listens in a thread, where nobody hears of errors, and would wait for ever.
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # then viser takes the next one
            raise InputError(
                f"{option('host', host)} {option('port', port)}: cannot listen there ({error.strerror}); choose others"
            ) from error
    return found


def _describe(soup: TriangleSoup) -> str:
    iteration = soup.notes.get("iteration")
    return f"{len(soup):,} triangles" + (f" after {int(iteration):,} iterations" if iteration else "")


def _without_banner() -> contextlib.AbstractContextManager[Any]:
    """Keeps viser from printing what it does: who started it says where the page is."""
    return contextlib.redirect_stdout(io.StringIO())


def _server_class() -> Any:
    try:
        import viser
    except ImportError as error:
        raise InputError("the viewer needs viser: pip install 'etsplat[viewer]'") from error

    class Private(viser.ViserServer):
        """Any page may ask viser for a tunnel through which everybody can look; this one makes none."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Does nothing."""

    return Private
