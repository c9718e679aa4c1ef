"""Nobody without the console's token, and no page of another site, gets past its guard: on the real server."""

from __future__ import annotations

import http.client
import json
import socket
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from ground_station.console.guard import Guard, guarded, listen
from ground_station.console.server import serving
from protocol.errors import BusError, ProcessError
from protocol.operation_settings import CONSOLE_FILE, Console

pytestmark = pytest.mark.light

PATIENCE_S = 10.0
SUBPROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@dataclass(frozen=True)
class Open:
    """A console that is served."""

    port: int
    token: str
    cookie: str

    def get(self, path: str = "/", headers: Mapping[str, str] | None = None) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        connection.request("GET", path, headers={"Host": f"127.0.0.1:{self.port}", **(headers or {})})
        answer = connection.getresponse()
        answer.read()
        connection.close()
        return answer

    def websocket(self, host: str = "", **headers: str) -> int:
        """Status with which a websocket is refused, 101 if it is opened."""
        try:
            with connect(
                f"ws://{host or '127.0.0.1'}:{self.port}/",
                sock=socket.create_connection(("127.0.0.1", self.port), PATIENCE_S),  # wherever the name points to
                additional_headers=headers,
                subprotocols=[SUBPROTOCOL],
                open_timeout=PATIENCE_S,
                max_size=None,
            ):
                return 101
        except InvalidStatus as refused:
            return refused.response.status_code


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Open]:
    folder = tmp_path_factory.mktemp("run")
    with serving(Console(port=0), "a mission", folder):
        url = urlsplit(json.loads((folder / CONSOLE_FILE).read_text())["url"])
        assert url.port is not None
        token = url.query.removeprefix("token=")
        yield Open(url.port, token, f"covrecon_console_{url.port}={token}")


def test_without_the_token_neither_the_page_nor_a_websocket_opens(console: Open) -> None:
    assert console.get().status == 401
    assert console.get("/?token=").status == 401
    assert console.get(f"/?token={console.token[:-1]}").status == 401
    assert console.get(f"/?token={console.token}&token={console.token}").status == 401
    assert console.websocket() == 401
    assert console.websocket(Cookie=f"covrecon_console_{console.port}=guess") == 401


def test_the_token_is_exchanged_for_a_cookie_that_opens_the_page_and_a_websocket(console: Open) -> None:
    answer = console.get(f"/?token={console.token}")

    assert answer.status == 200
    given = answer.getheader("Set-Cookie", "")
    assert given.startswith(console.cookie)
    assert "HttpOnly" in given
    assert "SameSite=Strict" in given
    assert answer.getheader("Referrer-Policy") == "no-referrer"
    page = console.get(headers={"Cookie": console.cookie})
    assert page.status == 200
    assert page.getheader("X-Frame-Options") == "DENY"
    assert "default-src 'self'" in page.getheader("Content-Security-Policy", "")
    assert console.websocket(Cookie=console.cookie) == 101


def test_the_cookie_of_a_console_at_another_port_is_worth_nothing(console: Open) -> None:
    assert console.get(headers={"Cookie": f"covrecon_console_1={console.token}"}).status == 401


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1", "https://127.0.0.1:{port}"])
def test_a_page_of_another_site_is_refused_even_with_the_cookie(console: Open, origin: str) -> None:
    origin = origin.format(port=console.port)

    assert console.get(headers={"Cookie": console.cookie, "Origin": origin}).status == 403
    assert console.websocket(Cookie=console.cookie, Origin=origin) == 403


def test_the_page_that_the_console_served_may_open_a_websocket(console: Open) -> None:
    assert console.websocket(Cookie=console.cookie, Origin=f"http://127.0.0.1:{console.port}") == 101


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "10.1.2.3"])
def test_a_name_that_was_made_to_point_here_is_refused_even_with_token_and_cookie(console: Open, host: str) -> None:
    headers = {"Host": f"{host}:{console.port}", "Cookie": console.cookie}

    assert console.get(f"/?token={console.token}", headers).status == 403
    assert console.get("/", headers).status == 403
    assert console.websocket(host, Cookie=console.cookie) == 403


@pytest.mark.parametrize("host", ["localhost:9000", "[::1]:9000"])
def test_whoever_comes_through_a_tunnel_from_another_port_is_let_in(console: Open, host: str) -> None:
    headers = {"Host": host, "Origin": f"http://{host}", "Cookie": console.cookie}

    assert console.get("/", headers).status == 200


def test_the_address_is_kept_where_only_its_owner_can_read_it_and_only_while_it_is_good(tmp_path: Path) -> None:
    address = tmp_path / CONSOLE_FILE
    address.write_text("of an earlier console")
    address.chmod(0o644)

    with serving(Console(port=0), "a mission", tmp_path):
        assert stat.S_IMODE(address.stat().st_mode) == 0o600

    assert not address.exists()


def test_a_port_that_is_taken_is_an_error_and_no_other_is_tried(tmp_path: Path) -> None:
    with listen("127.0.0.1", 0) as taken:
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(BusError, match=rf"console: cannot listen at 127\.0\.0\.1:{port}: Address already in use"),
            serving(Console(port=port), "a mission", tmp_path),
        ):
            pytest.fail("it was opened")


def test_an_address_of_another_computer_is_an_error() -> None:
    with pytest.raises(BusError, match=r"console: cannot listen at 192\.0\.2\.1:0"):
        listen("192.0.2.1", 0)


def test_a_viser_that_opens_its_server_in_another_way_is_not_used() -> None:
    with (
        listen("127.0.0.1", 0) as listening,
        pytest.raises(ProcessError, match="does not know"),
        guarded(Guard("127.0.0.1", "token"), listening),
    ):
        pass  # no server was opened where it was expected


def test_nothing_is_printed_and_nothing_is_shared_on_the_internet(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with serving(Console(port=0), "a mission", tmp_path) as server:
        server.request_share_url()
        assert server._share_tunnel is None

    assert capfd.readouterr().out == ""
    assert "asked to be shared" in caplog.text
