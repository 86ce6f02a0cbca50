"""The web server of the viewer: viser (an extra) draws the page, our engine the pictures.

Every browser has a thread of its own that waits for its camera to move. It draws small pictures while it moves, at the
width that `Pace` allows, and one of full width as soon as it stands still.
"""

import errno
import math
import socket
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from etsplat.core.cameras import Cameras, intrinsics
from etsplat.core.errors import InputError
from etsplat.data.camera_paths import focus_point
from etsplat.data.dataset import Dataset
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.sources import SoupRun, world_up
from etsplat.viewer.follow import Followed
from etsplat.viewer.guard import Guard
from etsplat.viewer.pace import Pace
from etsplat.viewer.pictures import MODES, picture

MOVING_SECONDS = 0.08
"""What a picture may take while the camera moves."""

STILL_AFTER = 0.2
"""Seconds without motion after which the picture is sharpened."""

TALLEST, MOST_PIXELS = 4, 1 << 26
"""Of a picture: its height in widths, and how large it is at most. Those for narrower windows are less wide."""

POLL_SECONDS = 2.0
CLOSING_SECONDS = 5.0
"""For which pictures that are being drawn are waited for at the end."""

FRUSTUM = 0.04
"""Size of the pictured cameras, relative to the scene's extent."""


class Viewer:
    """Serves one soup; `close` ends it."""

    def __init__(self, run: SoupRun, host: str, port: int, width: int) -> None:
        """Starts the server.

        Args:
            run: what to show.
            host: address to listen on.
            port: to listen on; the next free one is taken if it is in use.
            width: of still pictures, at most.

        Raises:
            InputError: viser is missing, or the address cannot be used.
        """
        server_class = _server_class()
        self._run, self._width = run, width
        self._soup = run.soup
        self._clients: dict[int, _Client] = {}
        self._closed = threading.Event()
        _check_address(host, port)
        with Guard(host).installed():
            self.server = server_class(host=host, port=port, verbose=False)
        self._build_page()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(lambda client: self._disconnected(client.client_id))
        if run.path.is_dir():
            threading.Thread(target=self._follow, args=(Followed(run.path, run.device),), daemon=True).start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return self.server.get_port()

    @property
    def soup(self) -> TriangleSoup:
        """What is shown now."""
        return self._soup

    @property
    def mode(self) -> Any:
        """The chosen mode."""
        return self._mode.value

    def close(self) -> None:
        """Ends the server and its threads."""
        self._closed.set()
        clients = list(self._clients.values())
        for client in clients:
            client.close()
        self.server.stop()
        for client in clients:
            client.worker.join(CLOSING_SECONDS)

    def _build_page(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_share_button=False)
        self._mode = gui.add_dropdown("Mode", MODES, initial_value="soft")
        self._show_cameras = gui.add_checkbox("Training cameras", False, disabled=self._run.capture is None)
        self._status = gui.add_markdown(_describe(self._soup))
        self._mode.on_update(lambda _: self._refresh())
        frusta: list[Any] = []
        if self._run.capture is not None:
            up = world_up(self._run.capture.viewmats)
            if up is not None:
                self.server.scene.set_up_direction(tuple(up.tolist()))
            frusta = _add_frusta(self.server, self._run.capture)

        def show_cameras(_: Any) -> None:
            for frustum in frusta:
                frustum.visible = self._show_cameras.value

        self._show_cameras.on_update(show_cameras)

    def _connected(self, client: Any) -> None:
        if self._run.capture is not None:
            _stand_at_first_camera(client, self._run.capture)
        else:
            _stand_before(client, self._soup)
        self._clients[client.client_id] = _Client(self, client, self._width)
        # viser calls this in a thread, maybe after the browser has gone and `_disconnected` was called.
        if self._closed.is_set() or client.client_id not in self.server.get_clients():
            self._disconnected(client.client_id)

    def _disconnected(self, identity: int) -> None:
        gone = self._clients.pop(identity, None)
        if gone is not None:
            gone.close()

    def _refresh(self) -> None:
        for client in list(self._clients.values()):
            client.redraw()

    def _follow(self, followed: Followed) -> None:
        while not self._closed.wait(POLL_SECONDS):
            soup = followed.poll()
            if soup is not None:
                self._soup = soup
                self._refresh()
            self._status.content = "\n\n".join(text for text in (_describe(self._soup), followed.status()) if text)


class _Client:
    """One browser: its thread draws whenever something changed."""

    def __init__(self, viewer: Viewer, client: Any, width: int) -> None:
        self._viewer, self._client = viewer, client
        self._pace = Pace(width, MOVING_SECONDS)
        self._changed = threading.Event()
        self._closed = self._failing = False
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
            self._draw(self._pace.full_width, quality=92)

    def _draw(self, width: int, quality: int = 70) -> None:
        camera = camera_of(self._client.camera, width)
        if camera is None:
            return
        try:
            pixels = picture(self._viewer.soup, camera, self._viewer.mode)
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


def _check_address(host: str, port: int) -> None:
    """Listens there for a moment: viser does so in a thread, where nobody hears of errors, and would wait for ever."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # then viser takes the next one
            raise InputError(
                f"--host {host} --port {port}: cannot listen there ({error.strerror}); choose others"
            ) from error


def _describe(soup: TriangleSoup) -> str:
    iteration = soup.notes.get("iteration")
    return f"{len(soup):,} triangles" + (f" after {int(iteration):,} iterations" if iteration else "")


def _add_frusta(server: Any, capture: Dataset) -> list[Any]:
    """A pyramid for every training camera, hidden; a click on one goes there."""
    rotations = capture.viewmats[:, :3, :3].mT
    frusta = []
    for index in capture.train:
        width, height = capture.images.sizes[index]
        frustum = server.scene.add_camera_frustum(
            f"/cameras/{capture.names[index]}",
            fov=2 * float(torch.atan(height / (2 * capture.Ks[index, 1, 1]))),
            aspect=width / height,
            scale=FRUSTUM * capture.extent,
            color=(230, 120, 40),
            wxyz=_quaternion(rotations[index]),
            position=capture.centers[index].numpy(),
            visible=False,
        )

        def go(event: Any, index: int = index) -> None:
            _stand_at(event.client, capture, index)

        frustum.on_click(go)
        frusta.append(frustum)
    return frusta


def _stand_at_first_camera(client: Any, capture: Dataset) -> None:
    _stand_at(client, capture, capture.train[0])


def _stand_at(client: Any, capture: Dataset, index: int) -> None:
    position = capture.centers[index]
    forward = capture.viewmats[index, 2, :3]
    # The point to turn about: on the line of sight, beside what all cameras look at.
    distance = float(((focus_point(capture.viewmats) - position) @ forward).clamp_min(0.05 * capture.extent))
    up = world_up(capture.viewmats)
    with client.atomic():
        client.camera.up_direction = (-capture.viewmats[index, 1, :3] if up is None else up).numpy()
        client.camera.position = position.numpy()
        client.camera.look_at = (position + distance * forward).numpy()
        client.camera.fov = 2 * float(torch.atan(capture.images.sizes[index][1] / (2 * capture.Ks[index, 1, 1])))


def _stand_before(client: Any, soup: TriangleSoup) -> None:
    """Without cameras: far enough away to see nine tenths of the triangles."""
    centers = soup.vertices.detach().mean(dim=1).cpu()
    middle = centers.median(dim=0).values
    distance = 2.5 * float(torch.quantile((centers - middle).norm(dim=1)[:1_000_000], 0.9))
    with client.atomic():
        client.camera.position = (middle + torch.tensor([0.3, 0.3, 0.9]) * distance).numpy()
        client.camera.look_at = middle.numpy()


def _quaternion(rotation: torch.Tensor) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix."""
    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat()
    return np.array([w, x, y, z])


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
