"""What a drone's agent needs of a vehicle, whatever flies it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from protocol.geometry import Floats


@dataclass(frozen=True, slots=True)
class Telemetry:
    """The vehicle's newest estimate of itself; ``pose`` and ``velocity`` are (5,), world frame."""

    pose: Floats
    velocity: Floats
    battery: float
    """Share left, 0 to 1."""
    stamp_s: float
    """Mission time at which it was true."""
    delay_s: float = 0.0
    """How much longer than one tick it takes until a command is flown."""


class Vehicle(Protocol):
    """``stop`` may be called from any thread, the rest from the event loop's. ``close`` may be called twice."""

    def telemetry(self) -> Telemetry | None:
        """None before the first one."""
        ...

    def send(self, tick: int, velocity: Floats) -> Floats:
        """Fly ``velocity`` (5,) from ``tick`` on; returns what was really sent after clipping."""
        ...

    def stop(self) -> None:
        """Zero velocity now, whatever was sent before."""
        ...

    def land(self) -> None:
        """Come down here and stay on the ground, whatever is sent later; may be called again."""
        ...

    def close(self) -> None: ...
