"""The air between hosts that stand in network namespaces: a link of given rate and delay to each, which can be cut.

A process of its own, so that no test's work delays a packet. It holds one TUN device in every namespace and passes IP
packets between them by their destination. In user space, because not every kernel has netem; TUN devices are
everywhere. `faults.hosts` starts it and talks to it by lines of JSON.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import math
import os
import select
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DEVICE = "air"
"""Name of the interface in each namespace."""
TUN = Path("/dev/net/tun")
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
NO_IPV6 = Path("/proc/sys/net/ipv6/conf/all/disable_ipv6")
"""Of the namespace of whoever opens it."""
CLONE_NEWNET = 0x40000000
PACKET_BYTES = 65536
"""More than any packet: without IFF_VNET_HDR the kernel cuts them to the MTU."""
IPV4_BYTES = 20
"""Of a header; the destination stands in its last four."""
PRIORITY = 1
"""Of the real-time scheduler's: above all that is not real-time. It takes a few per cent of a core."""
KEPT = 50_000
"""Of the newest packets it is known how late they were."""


@dataclass(frozen=True, slots=True)
class Shape:
    """Of a host's link, each way."""

    rate_bps: float = 5e6
    """Bits of IP packets a second."""
    delay_s: float = 0.03
    queue_s: float = 0.1
    """A packet that would wait longer for those before it is dropped: at 5 Mbit/s 62.5 kB wait, as before a radio."""


WIRE = Shape(math.inf, 0.0, math.inf)
"""A link that changes nothing."""


class Way:
    """One direction of a link: packets pass one after another at its rate, and then all take the same time."""

    def __init__(self, shape: Shape) -> None:
        self._shape = shape
        self._free_s = -math.inf
        self._flying: deque[tuple[float, bytes]] = deque()
        self.cut = False
        self.passed = self.dropped = self.lost = 0
        """Packets that got through, found the queue full, and vanished in a cut link."""

    def send(self, packet: bytes, now_s: float) -> None:
        begin_s = max(now_s, self._free_s)
        if self.cut:
            self.lost += 1
        elif begin_s - now_s > self._shape.queue_s:
            self.dropped += 1
        else:
            self._free_s = begin_s + 8 * len(packet) / self._shape.rate_bps
            self._flying.append((self._free_s + self._shape.delay_s, packet))

    @property
    def due_s(self) -> float:
        """When the next packet arrives."""
        return self._flying[0][0] if self._flying else math.inf

    def arrived(self, now_s: float) -> Iterator[tuple[float, bytes]]:
        """Packets that have arrived, and when they did; they are handed out once."""
        while self.due_s <= now_s:
            due_s, packet = self._flying.popleft()
            if self.cut:
                self.lost += 1
            else:
                self.passed += 1
                yield due_s, packet


class Host:
    """One namespace's device, and the two directions of its link."""

    def __init__(self, device: int, shape: Shape) -> None:
        self.device = device
        self.up, self.down = Way(shape), Way(shape)

    def cut(self, *, active: bool) -> None:
        self.up.cut = self.down.cut = active


class Air:
    def __init__(self, hosts: dict[str, Host], addresses: dict[bytes, Host]) -> None:
        self._hosts, self._addresses = hosts, addresses
        self._devices = {host.device: host for host in hosts.values()}
        self._late: deque[float] = deque(maxlen=KEPT)
        self._strays = 0
        self._line = b""

    def serve(self) -> None:
        """Until standard input ends."""
        commands = sys.stdin.fileno()
        while True:
            due_s = min(way.due_s for host in self._hosts.values() for way in (host.up, host.down))
            patience_s = None if due_s == math.inf else max(0.0, due_s - time.monotonic())
            readable, _, _ = select.select([commands, *self._devices], [], [], patience_s)
            for device in readable:
                if device != commands:
                    self._take_in(device)
                elif not self._obey(os.read(commands, PACKET_BYTES)):
                    return
            self._pass_on(time.monotonic())

    def _take_in(self, device: int) -> None:
        """All packets that a host has sent."""
        up = self._devices[device].up
        with suppress(BlockingIOError):
            while True:
                up.send(os.read(device, PACKET_BYTES), time.monotonic())

    def _pass_on(self, now_s: float) -> None:
        for host in self._hosts.values():
            for due_s, packet in host.up.arrived(now_s):
                target = self._addresses.get(packet[16:IPV4_BYTES])
                if target is None or packet[0] >> 4 != 4:
                    self._strays += 1
                else:
                    target.down.send(packet, due_s)
        for host in self._hosts.values():
            for due_s, packet in host.down.arrived(now_s):
                os.write(host.device, packet)
                self._late.append(now_s - due_s)

    # --- orders --------------------------------------------------------------------------------------------------

    def _obey(self, content: bytes) -> bool:
        """Whether to go on."""
        *lines, self._line = (self._line + content).split(b"\n")
        for line in lines:
            order = json.loads(line)
            if order["do"] == "tell":
                say(self._figures())
            else:
                self._hosts[order["host"]].cut(active=order["do"] == "cut")
                say({})
        return bool(content)

    def _figures(self) -> dict[str, Any]:
        late = sorted(self._late) or [0.0]
        return {
            "cpu_s": time.process_time(),
            "late_p50_s": late[len(late) // 2],
            "late_p99_s": late[len(late) * 99 // 100],
            "late_max_s": late[-1],
            "strays": self._strays,
            "ways": {
                f"{name} {direction}": {"passed": way.passed, "dropped": way.dropped, "lost": way.lost}
                for name, host in self._hosts.items()
                for direction, way in (("up", host.up), ("down", host.down))
            },
        }


def say(answer: dict[str, Any]) -> None:
    print(json.dumps(answer), flush=True)


def enter(namespace: Path) -> None:
    """Move the calling thread, and threads and processes that it starts from now on, to a network namespace."""
    libc = ctypes.CDLL(None, use_errno=True)
    with namespace.open() as file:
        if libc.setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(namespace))


def open_device(namespace: Path) -> int:
    """A TUN device there; it lives for as long as its descriptor, wherever that is used."""
    enter(namespace)
    with suppress(OSError):  # then the kernel's own greetings of IPv6 are counted with the rest
        NO_IPV6.write_text("1")
    device = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), IFF_TUN | IFF_NO_PI))
    return device


def main(hosts: Sequence[dict[str, Any]]) -> None:
    """``hosts``: name, namespace, address and shape of each."""
    with suppress(PermissionError):  # then it is as late as the machine is busy
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    made, addresses = {}, {}
    for host in hosts:
        made[host["name"]] = Host(open_device(Path(host["namespace"])), Shape(*host["shape"]))
        addresses[socket.inet_aton(host["address"])] = made[host["name"]]
    say({})
    Air(made, addresses).serve()


if __name__ == "__main__":
    main(json.loads(sys.stdin.buffer.readline()))
