"""A server on this machine for pages that load modules: browsers refuse them from files."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

PAGES = Path(__file__).parent


class _Handler(SimpleHTTPRequestHandler):
    def __init__(self, *arguments: object, npm: Path, file: Path, **more: object) -> None:
        self._npm, self._file = npm, file
        super().__init__(*arguments, **more)  # pyright: ignore[reportArgumentType]

    def translate_path(self, path: str) -> str:
        """Pages beside this module, modules below /npm/, and /file.glb."""
        path = unquote(urlsplit(path).path)
        if path == "/file.glb":
            return str(self._file)
        if path.startswith("/npm/") and ".." not in path:
            return str(self._npm / "node_modules" / path.removeprefix("/npm/"))
        return str(PAGES / Path(path).name)

    def log_message(self, *_: object) -> None:
        """Says nothing."""


@contextmanager
def serving(npm: Path, file: Path) -> Iterator[str]:
    """The address of a server for the pages of this folder, npm's modules and a GLB file."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, npm=npm, file=file))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
