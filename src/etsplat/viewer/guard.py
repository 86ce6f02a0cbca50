"""Who may talk to the viewer: pages that it served itself, opened by an address that it listens at.

A browser sends any page's requests to any server that it can reach, this machine's included, and lets scripts talk to a
websocket whoever they come from: the server has to look. `Host` is the address in the browser's bar: a stranger's name
that leads here is refused (DNS rebinding). `Origin` is the page that asks: it must be the one of that address.
"""

import contextlib
import http
import ipaddress
import socket
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})


class Guard:
    """Looks at every request before viser does."""

    def __init__(self, host: str) -> None:
        """Of a server that listens at `host`."""
        self._anywhere = host in ("", "0.0.0.0", "::")
        machine = socket.gethostname().lower()
        self._names = {host.lower(), machine, f"{machine}.local", *_LOOPBACK}

    def refusal(self, hosts: list[str], origins: list[str]) -> str | None:
        """Why a request with these headers is refused; None if it is not.

        Args:
            hosts: values of `Host`; there must be one, with or without a port.
            origins: values of `Origin`; programs that are no browsers send none.
        """
        name = _name_of(hosts[0]) if len(hosts) == 1 else None
        if name is None or not self._is_here(name):
            return "this viewer does not answer to that host: open it by the address that it printed"
        if any(
            origin.lower() not in (f"http://{hosts[0]}".lower(), f"https://{hosts[0]}".lower()) for origin in origins
        ):
            return "this viewer answers to its own page only"
        return None

    def _is_here(self, name: str) -> bool:
        if name in self._names:
            return True
        # Listening everywhere, it cannot know the addresses that lead here; but no stranger can give those to a page.
        return self._anywhere and _is_address(name)

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """A viser server that starts within the block is guarded.

        Raises:
            RuntimeError: none started that way, as of a version of viser that is made differently.
        """
        import websockets.asyncio.server as websocket_server

        serve, guarded = websocket_server.serve, []

        def guarded_serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
            guarded.append(True)
            return serve(*args, process_request=self._before(process_request), **options)

        with mock.patch.object(websocket_server, "serve", guarded_serve):
            yield
        if not guarded:
            raise RuntimeError("this version of viser starts its server in another way: etsplat cannot guard it")

    def _before(self, process_request: Callable[..., Any]) -> Callable[..., Any]:
        def look(connection: Any, request: Any) -> Any:
            refusal = self.refusal(request.headers.get_all("Host"), request.headers.get_all("Origin"))
            if refusal is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal}\n")
            response = process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"  # nobody clicks through a frame
            return response

        return look


def _name_of(host: str) -> str | None:
    """The name or address of a `Host` header, in lower case; None if it is none."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
