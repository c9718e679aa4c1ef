"""Opens viser's server behind the console's guard, and closes it."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import secrets
import sys
from collections.abc import Iterator
from pathlib import Path

import viser

from ground_station.console.guard import TOKEN_BYTES, Guard, guarded, is_loopback, listen
from ground_station.durable import draft_of
from protocol.operation_settings import CONSOLE_FILE, Console

log = logging.getLogger(__name__)


class Server(viser.ViserServer):
    """viser's without its tunnel through a public server, which a page could ask for."""

    def request_share_url(self, verbose: bool = True) -> None:  # noqa: ARG002  # viser's
        log.warning("a page asked to be shared on the internet: refused")


@contextlib.contextmanager
def serving(settings: Console, title: str, run: Path) -> Iterator[Server]:
    """A server while the block runs; its address with the token is logged, and kept in the folder ``run``.

    Raises:
        BusError: the address is taken; no other is tried.
        ProcessError: this viser cannot be guarded.
    """
    token = secrets.token_urlsafe(TOKEN_BYTES)
    if not is_loopback(settings.host):
        log.warning("console: %s is open to others, and nothing that they see or send is encrypted", settings.host)
    with listen(settings.host, settings.port) as listening:
        port = listening.getsockname()[1]
        with contextlib.redirect_stdout(io.StringIO()), guarded(Guard(settings.host, token), listening):
            server = Server(settings.host, port, label=title, verbose=False)  # prints an address without the token
        address = run / CONSOLE_FILE
        with contextlib.redirect_stdout(sys.stderr):  # viser says when it stops, and when a page is not of its version
            try:
                url = f"http://{_in_url(settings.host)}:{port}/?token={token}"
                _write_private(address, json.dumps({"url": url}))
                log.info("console: %s", url)
                yield server
            finally:
                address.unlink(missing_ok=True)
                server.stop()


def _in_url(host: str) -> str:
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  # what a browser here reaches it by
    return f"[{host}]" if ":" in host else host


def _write_private(path: Path, text: str) -> None:
    """For nobody else's eyes, at no moment, and whole as soon as it is there."""
    draft = draft_of(path)
    draft.unlink(missing_ok=True)
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text + "\n")
    draft.replace(path)
