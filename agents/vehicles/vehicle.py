"""What a drone's agent needs of a vehicle, whatever flies it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from protocol.geometry import Floats

Authority = Literal["ready", "starting", "ours", "yielded", "landing", "landed", "lost"]
"""Who flies, and how far it is. ready: on the ground, checks passed. starting: arming, taking off, until it obeys.
ours: it flies what it is sent. yielded: a pilot or a failsafe of its own flies; nothing is sent. landing: it comes down
by itself, told by us. landed: on the ground after it flew; it will not start again, unless it is made ready. lost:
nothing is heard of it."""


@dataclass(frozen=True, slots=True)
class Telemetry:
    """The vehicle's newest estimate of itself; ``pose`` and ``velocity`` are (5,), world frame."""

    pose: Floats
    velocity: Floats
    battery: float
    """Share left, 0 to 1."""
    stamp_s: float
    """When it was true, by the clock that the agent judges silence by (`protocol.clock.Clock.now_s`)."""
    delay_s: float = 0.0
    """How much longer than one tick it takes until a command is flown."""
    rotation: Floats | None = None
    """(3, 3) camera to world, where the camera tilts with the airframe; None: that of the pose."""
    position_sd_m: float = 0.0
    """Standard deviation of the position, along the direction in which it is largest; 0 where nobody tells one ..."""
    angle_sd_rad: float = 0.0
    """... and of yaw and pitch."""

    @property
    def deviations(self) -> tuple[float, float]:
        """Both."""
        return self.position_sd_m, self.angle_sd_rad


@dataclass(frozen=True, slots=True)
class SeenPose:
    """Where the vehicle's body was seen from outside, world frame."""

    position: Floats
    """(3,)"""
    rotation: Floats
    """(3, 3) body (x forward, y left, z up) to world."""
    position_sd_m: float
    """Standard deviation of each coordinate ..."""
    angle_sd_rad: float
    """... and about each axis."""
    at_s: float
    """When it was true, by the same clock as `Telemetry.stamp_s`."""
    resets: int = 0
    """How often so far what is seen has been believed anew, elsewhere than expected."""


@dataclass(frozen=True, slots=True)
class Condition:
    authority: Authority
    reason: str = ""
    """Why, for people: "pilot switched to POSCTL", "taking off: 1.2 of 1.6 m"."""
    gimbal_lost: bool = False
    """The camera no longer points where it is told."""
    jumps: int = 0
    """How often the position estimate has jumped so far."""


class Vehicle(Protocol):
    """``stop``, ``hold`` and ``land`` may be called from any thread and never block for longer than a command takes
    to be acknowledged (some seconds); the rest belongs to the event loop's. ``close`` may be called twice."""

    async def prepare(self) -> None:
        """Connect, and check until it may take off; or find it in the air, and take over.

        Raises:
            VehicleError: it was not heard, is somebody else's, or did not pass; every red item is named.
        """
        ...

    def take_off(self) -> None:
        """Climb to the start pose's height, from then on fly what is sent; `condition` tells how far that is.
        Nothing happens when it flies already."""
        ...

    def condition(self) -> Condition: ...

    def telemetry(self) -> Telemetry | None:
        """None before the first one."""
        ...

    def aid(self, seen: SeenPose) -> None:
        """For the vehicle's own estimator, where it has one; also before `prepare` has ended, which may wait for it."""
        ...

    def send(self, tick: int, velocity: Floats) -> Floats:
        """Fly ``velocity`` (5,) from ``tick`` on; returns what was really sent after clipping."""
        ...

    def pass_tick(self, tick: int) -> None:
        """Nothing is sent for ``tick``, because the vehicle does not fly for us: tell whoever waits for a command."""
        ...

    def stop(self) -> None:
        """Zero velocity now, whatever was sent before."""
        ...

    def hold(self) -> None:
        """Keep the place by the vehicle's own means, so that nothing need be sent any more."""
        ...

    def land(self) -> None:
        """Come down here and stay on the ground, whatever is sent later; may be called again."""
        ...

    def make_ready(self) -> bool:
        """It stands on the ground with another battery: from "landed" to "ready", as before its first take-off. False
        when it has not landed, or is armed, or while it is checked again, which begins with the first call: then
        nothing happens, and one may ask again."""
        ...

    def leave(self, *, hold: bool) -> None:
        """The control task ends: what flies for us lands, or holds its place, whatever happens to this process next."""
        ...

    def close(self) -> None: ...
