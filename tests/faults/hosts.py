"""Many hosts on one machine: a network namespace each, joined to a star by links that are slow, late and can be cut.

Whatever runs in a host reaches the others at their addresses and nothing else. A cut link loses packets silently, as a
radio out of range does: interfaces stay up, and nobody is told.
"""

from __future__ import annotations

import ipaddress
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import astuple
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from faults import radio
from faults.radio import DEVICE, TUN, Shape

NETWORK = ipaddress.ip_network("10.77.0.0/24")
"""Seen only inside the namespaces, so it may be any."""
NAMESPACES = Path("/run/netns")
"""Where iproute2 keeps their names."""
OWNED = re.compile(r"covrecon-(\d+)-.+")
"""Names of ours, with the id of the process that made them."""
MTU = 1500


class HostsError(Exception):
    """The namespaces or their links cannot be had, or were lost."""


def reason_against_hosts() -> str | None:
    """Why hosts cannot be made here; None where they can."""
    for program, package in (("ip", "iproute2"), ("nsenter", "util-linux")):
        if shutil.which(program) is None:
            return f"no {program} on this machine: apt-get install {package}"
    name = _name("trial")
    try:
        _ip("netns", "add", name)
    except HostsError as error:
        return f"network namespaces cannot be made: {error}"
    try:
        _ip("-n", name, "tuntap", "add", DEVICE, "mode", "tun")
    except HostsError as error:
        return f"TUN devices cannot be made: {error}"
    finally:
        _ip("netns", "del", name)
    return None if os.access(TUN, os.R_OK | os.W_OK) else f"{TUN} cannot be opened"


class Hosts(AbstractContextManager["Hosts"]):
    """Hosts by name, with addresses counted up from 10.77.0.1 in the order of ``links``."""

    def __init__(self, links: Mapping[str, Shape]) -> None:
        self._links = dict(links)
        self._addresses = dict(zip(self._links, map(str, NETWORK.hosts()), strict=False))
        self._radio: subprocess.Popen[str]
        self._stack = ExitStack()
        self._started: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Self:
        sweep()
        with ExitStack() as stack:
            for host in self._links:
                _ip("netns", "add", _name(host))
                stack.callback(_ip, "netns", "del", _name(host))
            self._radio = stack.enter_context(_running_radio())
            stack.callback(self._end_started)
            self._ask(
                [
                    {
                        "name": host,
                        "namespace": str(self.namespace(host)),
                        "address": self._addresses[host],
                        "shape": astuple(shape),
                    }
                    for host, shape in self._links.items()
                ]
            )
            for host in self._links:
                self._bring_up(host)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _bring_up(self, host: str) -> None:
        inside = ("-n", _name(host))
        _ip(*inside, "link", "set", "lo", "up")
        _ip(*inside, "link", "set", DEVICE, "mtu", str(MTU), "multicast", "off", "up")
        _ip(*inside, "address", "add", f"{self._addresses[host]}/{NETWORK.prefixlen}", "dev", DEVICE)

    # --- hosts ---------------------------------------------------------------------------------------------------

    def address(self, host: str) -> str:
        return self._addresses[host]

    def namespace(self, host: str) -> Path:
        return NAMESPACES / _name(host)

    def command(self, host: str, *command: str) -> tuple[str, ...]:
        """``command`` as it runs inside ``host``, from whatever host it is started; the process keeps its id."""
        return ("nsenter", f"--net={self.namespace(host)}", *command)

    def start(self, host: str, *command: str, log: Path, **options: Any) -> subprocess.Popen[bytes]:
        """Start a command there; it is killed at the end if it has not ended. ``log`` gets its output behind what is
        there; ``options`` are `Popen`'s."""
        with log.open("ab") as output:
            process = subprocess.Popen(
                self.command(host, *command),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                **options,
            )
        self._started.append(process)
        return process

    def socket(self, host: str, kind: socket.SocketKind) -> socket.socket:
        """A socket of that host, bound to its address, for use by this process."""

        def make() -> socket.socket:
            radio.enter(self.namespace(host))
            made = socket.socket(socket.AF_INET, kind)
            made.bind((self._addresses[host], 0))
            return made

        with ThreadPoolExecutor(1) as visitor:  # a socket stays where it was made, whoever uses it
            return visitor.submit(make).result()

    def enter(self, host: str) -> None:
        """Go there for good, with all that is started from now on; for a program's only thread."""
        radio.enter(self.namespace(host))

    def _end_started(self) -> None:
        for process in self._started:
            process.kill()  # no effect on one that has ended
            process.wait()

    # --- links ---------------------------------------------------------------------------------------------------

    def cut(self, host: str) -> None:
        """From now on nothing arrives in either direction, what is under way included."""
        self._ask({"do": "cut", "host": host})

    def heal(self, host: str) -> None:
        self._ask({"do": "heal", "host": host})

    def bytes_up(self, host: str) -> int:
        """Bytes of IP packets that ``host`` has sent, by its interface's counter: also those that then were lost."""
        return self._count(host, "tx")

    def bytes_down(self, host: str) -> int:
        """... and that it has received."""
        return self._count(host, "rx")

    def _count(self, host: str, direction: str) -> int:
        (interface,) = json.loads(_ip("-n", _name(host), "-json", "-statistics", "link", "show", DEVICE))
        count: int = interface["stats64"][direction]["bytes"]
        return count

    def figures(self) -> dict[str, Any]:
        """Of the process that passes the packets on: its CPU time, how much later than they should packets arrived,
        and what became of the packets of each direction."""
        return self._ask({"do": "tell"})

    def _ask(self, order: object) -> dict[str, Any]:
        assert self._radio.stdin is not None
        assert self._radio.stdout is not None
        with suppress(BrokenPipeError):
            print(json.dumps(order), file=self._radio.stdin, flush=True)
        line = self._radio.stdout.readline()
        if not line:
            raise HostsError(f"the links are gone: the process that passes packets on ended, {self._radio.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextmanager
def _running_radio() -> Iterator[subprocess.Popen[str]]:
    """The process that passes packets on, and with it its devices; it ends with its standard input."""
    process = subprocess.Popen(
        [sys.executable, "-m", "faults.radio"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(radio.__file__).parents[1])},
    )
    try:
        yield process
    finally:
        process.communicate()


def sweep() -> None:
    """Remove what runs that were killed have left: their namespaces, and what still runs in them."""
    for entry in NAMESPACES.glob("covrecon-*"):
        owned = OWNED.fullmatch(entry.name)
        if owned and not Path("/proc", owned[1]).exists():
            for pid in _ip("netns", "pids", entry.name).split():
                with suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)
            _ip("netns", "del", entry.name)


def _name(host: str) -> str:
    return f"covrecon-{os.getpid()}-{host}"


def _ip(*arguments: str) -> str:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)  # noqa: S607  # in /usr/sbin or /sbin
    if done.returncode:
        raise HostsError(f"ip {' '.join(arguments)}: {done.stderr.strip() or f'exit code {done.returncode}'}")
    return done.stdout
