"""A browser without a window that opens pages of this package: Chromium, with WebGL in software."""

import base64
import io
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    *("--headless=new", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--no-first-run", "--disable-extensions", "--disable-background-networking", "--disable-dev-shm-usage"),
    *("--hide-scrollbars", "--remote-debugging-port=0"),
)
WEBGPU = ("--enable-unsafe-webgpu", "--enable-features=Vulkan", "--use-vulkan=swiftshader")
"""Flags for WebGPU in software: its canvases stay empty where the browser's own pictures are not made by Vulkan too."""

PATIENCE = 120.0
"""Seconds for any answer."""


def find_browser() -> str | None:
    """Where the browser is, if there is one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Page:
    """An open page, which is asked by the protocol of the browser's own tools."""

    def __init__(self, connection: Any, browser: str) -> None:
        self._connection, self._browser, self._count = connection, browser, 0
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Network"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a command. What the page reports meanwhile as an error is kept."""
        self._count += 1
        self._connection.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            said = json.loads(self._connection.recv(timeout=PATIENCE))
            if said.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(said["params"]["exceptionDetails"])[:2000])
            if said.get("method") == "Network.requestWillBeSent":
                address = said["params"]["request"]["url"]
                if not address.startswith(("file:", "data:", "blob:")):
                    self.errors.append(f"asked for {address}")
            if said.get("id") == self._count:
                assert "error" not in said, said
                return said["result"]

    def open(
        self,
        path: Path,
        width: int = 1280,
        height: int = 720,
        *,
        phone: bool = False,
        query: str = "",
        before: str = "",
    ) -> None:
        """Opens a file in a window of so many pixels.

        Args:
            path: of the file.
            width: of the window.
            height: of the window.
            phone: whether it is one, with two pixels for each along each side.
            query: what stands behind the file's name in the address.
            before: a script that runs before those of the page.
        """
        scale = 2 if phone else 1
        self.ask(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=phone
        )
        added = self.ask("Page.addScriptToEvaluateOnNewDocument", source=before)
        self.visit(path.resolve().as_uri() + query)
        self.ask("Page.removeScriptToEvaluateOnNewDocument", **added)

    def visit(self, address: str) -> None:
        """Goes to an address, and waits until what is there has come."""
        self.ask("Page.navigate", url=address)
        end = time.monotonic() + PATIENCE
        while self.value("document.readyState === 'complete' ? location.href : ''") != address:
            assert time.monotonic() < end
            time.sleep(0.05)

    def value(self, code: str) -> Any:
        """What an expression, or the promise that it is, comes to; waits until the page knows its names."""
        end = time.monotonic() + PATIENCE
        while True:
            found = self.ask("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
            if "exceptionDetails" not in found:
                return found["result"].get("value")
            assert "ReferenceError" in json.dumps(found), found
            assert time.monotonic() < end, found
            time.sleep(0.1)

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element in the window."""
        found = f"(({{ x, y, width, height }}) => [x, y, width, height])({_element(selector)}.getBoundingClientRect())"
        left, top, width, height = self.value(found)
        return left, top, width, height

    def click(self, selector: str) -> None:
        """Presses the mouse on the middle of an element, which must be seen there."""
        left, top, width, height = self.box(selector)
        x, y = left + width / 2, top + height / 2
        assert self.value(f"{_element(selector)}.contains(document.elementFromPoint({x}, {y}))"), (
            f"{selector} is covered"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, selector: str, dx: float, dy: float) -> None:
        """Moves the pressed mouse from the middle of an element."""
        left, top, width, height = self.box(selector)
        x, y = left + width / 2, top + height / 2
        for kind, at in (
            ("mousePressed", (x, y)),
            ("mouseMoved", (x + dx, y + dy)),
            ("mouseReleased", (x + dx, y + dy)),
        ):
            place = {"x": at[0], "y": at[1]}
            self.ask("Input.dispatchMouseEvent", type=kind, **place, button="left", buttons=1, clickCount=1)

    def press(self, key: str, code: int = 0) -> None:
        """A key, of what has the focus; `code` where it is none of a character."""
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def processor_seconds(self) -> float:
        """What the browser's processes have taken together until now."""
        from websockets.sync.client import connect

        with connect(self._browser, max_size=None, compression=None) as connection:
            connection.send(json.dumps({"id": 1, "method": "SystemInfo.getProcessInfo"}))
            found = json.loads(connection.recv(timeout=PATIENCE))
        return sum(process["cpuTime"] for process in found["result"]["processInfo"])

    def picture(self, code: str) -> np.ndarray:
        """(H, W, 3) in [0, 1] of a canvas, or of the promise of one."""
        return self.decoded(self.value(f"(async () => (await ({code})).toDataURL('image/png'))()").split(",")[1])

    def screenshot(self) -> np.ndarray:
        """(H, W, 3) in [0, 1] of the window."""
        return self.decoded(self.ask("Page.captureScreenshot", format="png")["data"])

    def decoded(self, text: str) -> np.ndarray:
        """(H, W, 3) in [0, 1] of a picture file in base64."""
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB")) / 255


def _element(selector: str) -> str:
    return f"document.querySelector({json.dumps(selector)})"


@contextmanager
def browser_page(*flags: str) -> Iterator[Page]:
    """A page of a browser of its own, with these flags besides the usual ones.

    Raises:
        AssertionError: there is no browser.
    """
    from websockets.sync.client import connect

    program = find_browser()
    assert program is not None
    with TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        command = [program, *FLAGS, *flags, *root, f"--user-data-dir={profile}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = _port(Path(profile) / "DevToolsActivePort", process)
            pages = [page for page in _answer(port, "list") if page["type"] == "page"]
            with connect(pages[0]["webSocketDebuggerUrl"], max_size=None, compression=None) as connection:
                yield Page(connection, _answer(port, "version")["webSocketDebuggerUrl"])
        finally:
            process.terminate()
            process.wait(PATIENCE)


def _answer(port: int, question: str) -> Any:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/{question}", timeout=PATIENCE) as answer:
        return json.load(answer)


def _port(file: Path, process: "subprocess.Popen[bytes]") -> int:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        assert process.poll() is None, "the browser ended"
        if file.is_file() and (lines := file.read_text().splitlines()):
            return int(lines[0])
        time.sleep(0.05)
    raise AssertionError("the browser does not answer")
