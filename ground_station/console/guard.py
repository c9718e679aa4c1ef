"""Who may use the console: whoever has its token, from a page that the console itself served.

viser lets any web page that the operator opens connect to it and press its buttons. It offers no hook, so the one call
that opens its server is wrapped: it gets a socket of ours, and each request, of HTTP and of websockets, is judged
before viser sees it.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from protocol.errors import BusError, ProcessError

log = logging.getLogger(__name__)

TOKEN_BYTES = 24
"""Of randomness: 192 bits, far more than can be tried."""
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the token must not travel on
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",  # no foreign page may lure clicks onto buttons that it covers
    # viser's page is one file with its scripts in it, which compile WebAssembly and start workers from blobs. Nothing
    # is loaded from or sent to anywhere else, also if text of a message should ever become markup.
    "Content-Security-Policy": (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'; form-action 'none'"
    ),
}
ENTRANCE = '<!doctype html><meta charset="utf-8"><title>Console</title><meta http-equiv="refresh" content="0;url=/">'
"""What the token's bearer gets first. The page goes on by itself: after a redirect, a browser that came from another
site's link would keep back a cookie that is for this site alone."""


class Guard:
    """Judges requests; ``host`` is the address that the console listens at."""

    def __init__(self, host: str, token: str) -> None:
        self._host, self._token = host, token
        self.refused: Counter[str] = Counter()
        """Requests that were turned away, by reason."""

    def judge(self, request: Request, port: int) -> Response | None:
        """The answer to a request that may not, or need not, go any further; None for one that may."""
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return self._refuse(HTTPStatus.FORBIDDEN, "not the console's address")
        if origins and origins != [f"http://{hosts[0]}"]:
            return self._refuse(HTTPStatus.FORBIDDEN, "not the console's own page")
        cookie = f"covrecon_console_{port}"  # cookies know no ports: two consoles would take each other's
        if self._is_token(*parse_qs(request.path.partition("?")[2]).get("token", [])):
            answer = _response(HTTPStatus.OK, ENTRANCE, "text/html; charset=utf-8")
            answer.headers["Set-Cookie"] = f"{cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
            return answer
        if not any(self._is_token(value) for value in _cookies(headers, cookie)):
            return self._refuse(HTTPStatus.UNAUTHORIZED, "open the address with the token that the console printed")
        if request.path == "/favicon.ico":  # which browsers ask for by themselves, and viser has not
            return _response(HTTPStatus.NO_CONTENT, "", "image/x-icon")
        return None

    def _is_ours(self, host: str) -> bool:
        """Whether a browser that was sent here by this name meant the console.

        A page of another site that makes its own name point here is told by that name. Any port will do, or the
        console could not be reached through ``ssh -L``: the page's origin has to have the same.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in ("localhost", self._host.lower()):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not is_loopback(self._host)

    def _is_token(self, *given: str) -> bool:
        return len(given) == 1 and hmac.compare_digest(given[0].encode(errors="replace"), self._token.encode())

    def _refuse(self, status: HTTPStatus, reason: str) -> Response:
        """Log the 1st, 2nd, 4th, 8th ...: a page that tries on must not fill the disk."""
        self.refused[reason] += 1
        if self.refused[reason].bit_count() == 1:
            log.warning("refused a request: %s (%d so far)", reason, self.refused[reason])
        return _response(status, f"{reason}\n", "text/plain; charset=utf-8")


def is_loopback(host: str) -> bool:
    """Whether ``host`` can be reached from this computer alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@contextmanager
def guarded(guard: Guard, listening: socket.socket) -> Iterator[None]:
    """While the block runs, the server that viser opens listens at ``listening`` and asks ``guard`` first.

    Raises:
        ProcessError: no server was opened in the block, or not in the way that can be guarded.
    """
    serve = websockets.asyncio.server.serve
    port = int(listening.getsockname()[1])
    wrapped = 0

    def guarded_serve(
        handler: Callable[..., Any],
        host: str,  # noqa: ARG001  # viser's, and that it would try the next port when one is taken
        port_wished: int,  # noqa: ARG001  # likewise
        *,
        process_request: Callable[[ServerConnection, Request], Response | None],
        **options: Any,
    ) -> websockets.asyncio.server.serve:
        nonlocal wrapped
        wrapped += 1

        def process(connection: ServerConnection, request: Request) -> Response | None:
            answer = guard.judge(request, port)
            if answer is not None:
                return answer
            answer = process_request(connection, request)
            if answer is not None:
                for name, value in HEADERS.items():
                    answer.headers[name] = value
            return answer

        return serve(handler, sock=listening, process_request=process, server_header=None, **options)

    server: Any = websockets.asyncio.server
    server.serve = guarded_serve
    try:
        yield
    finally:
        server.serve = serve
    if wrapped != 1:
        raise ProcessError("viser opens its server in a way that the console's guard does not know: not started")


def listen(host: str, port: int) -> socket.socket:
    """A socket bound to exactly this address; with port 0 to any that is free.

    Raises:
        BusError: it is taken, or none of this computer's.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, protocol)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one that was started again need not wait
            listening.bind(address)
        except OSError:
            listening.close()
            raise
    except OSError as error:
        raise BusError(
            f"console: cannot listen at {host}:{port}: {error.strerror}; set console.port, 0 for any that is free"
        ) from error
    return listening


def _cookies(headers: Headers, name: str) -> list[str]:
    pairs = (pair.strip().partition("=") for line in headers.get_all("Cookie") for pair in line.split(";"))
    return [value for key, _, value in pairs if key == name]


def _response(status: HTTPStatus, text: str, mime_type: str) -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": mime_type, "Content-Length": str(len(body)), "Connection": "close", **HEADERS})
    return Response(status.value, status.phrase, headers, body)
