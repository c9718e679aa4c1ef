"""Links on which nothing is acknowledged any more are given up after a lease, not after a quarter of an hour.

zenoh notices within a lease that nothing comes in. But before it tells anybody that the process at the other end is
gone, or looks for another router, it closes the link, and over TLS that waits for what is being written. Once the
kernel's buffer is full, that is until TCP gives up. zenoh 1.10.2, 150 kB/s to a host whose radio link was cut: its
token went after 985 s, over plain TCP after 2 s. So TCP is told to give up as early.
"""

from __future__ import annotations

import os
import socket
import stat
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from protocol.endpoints import internet_endpoint
from protocol.session import LEASE_MS

UNACKNOWLEDGED_MS = LEASE_MS
"""What the other end does not acknowledge for so long ends the connection; then the lease is over as well."""
DESCRIPTORS = Path("/proc/self/fd")


def give_up_stuck_links(session: zenoh.Session) -> Any:
    """Hold each link of ``session``, now and later, to `UNACKNOWLEDGED_MS`, for as long as the result is kept."""

    def change(event: zenoh.LinkEvent) -> None:
        if event.kind == zenoh.SampleKind.PUT:
            _hasten(str(event.link.src), str(event.link.dst))

    return session.info.declare_link_events_listener(change, history=True)


def _hasten(source: str, target: str) -> None:
    """zenoh does not hand out its sockets, so the one between these two ports is sought among all of this process."""
    here, there = internet_endpoint(source), internet_endpoint(target)
    if here is None or there is None:
        return
    for entry in DESCRIPTORS.iterdir():
        with suppress(OSError):  # another thread has closed it, or it has no other end
            descriptor = int(entry.name)
            if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                with socket.socket(fileno=os.dup(descriptor)) as same:
                    if _ports(same) == (here[2], there[2]):
                        same.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNACKNOWLEDGED_MS)


def _ports(tcp: socket.socket) -> tuple[int, int] | None:
    """Of both ends, if it is a connection of TCP."""
    if tcp.type != socket.SOCK_STREAM or tcp.family not in (socket.AF_INET, socket.AF_INET6):
        return None
    return tcp.getsockname()[1], tcp.getpeername()[1]
