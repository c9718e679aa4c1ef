"""The library that speaks to motion capture systems, in a process of its own.

libmotioncapture waits for frames while it holds Python's global lock, for ever when a system has gone: in a process it
stands in nobody's way, and can be ended.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Final

from ground_station.motion_capture.bodies import Seen
from protocol.errors import ProcessError
from protocol.mission import Mission

END_S: Final = 2.0
"""How long the process may take to end."""


@dataclass(frozen=True, slots=True)
class Frame:
    seen: Mapping[str, Seen]
    """By the body's name."""
    at_s: float
    """When it came, monotonic: the same clock in all processes of a machine."""


@dataclass(frozen=True, slots=True)
class Failure:
    reason: str


class Eye:
    """One connection to a system; ``connection`` has a `Frame` or, as its last word, a `Failure`."""

    def __init__(self, mission: Mission) -> None:
        """Raises: ProcessError: the library is not installed."""
        require_library()
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe(duplex=False)
        settings = mission.mocap
        self._process = context.Process(
            target=_watch, args=(theirs, settings.system, configuration(mission)), name="motion-capture", daemon=True
        )
        self._process.start()
        theirs.close()

    def close(self) -> None:
        """Also while it waits for a frame; may be called twice."""
        self._process.kill()  # it does not listen
        self._process.join(END_S)
        self.connection.close()


def require_library() -> None:
    """Raises: ProcessError: the library is not installed."""
    try:
        import motioncapture  # noqa: F401
    except ImportError as error:
        raise ProcessError('motion capture needs a library: pip install "coverage-recon[mocap]"') from error


def configuration(mission: Mission) -> dict[str, str]:
    """What the library is told of the system."""
    told = {"hostname": mission.mocap.host}
    if mission.mocap.system == "mock":
        told["rigid_bodies"] = ";".join(
            f"{drone.rigid_body}({drone.start[0]},{drone.start[1]},{drone.start[2]},1,0,0,0)"
            for drone in mission.drones
        )
    return told


def _watch(connection: Connection, system: str, told: Mapping[str, str]) -> None:
    """The process: every frame, until nobody reads them any more."""
    import motioncapture

    with suppress(KeyboardInterrupt, ConnectionError):
        try:
            capture = motioncapture.connect(system, dict(told))
            while True:
                capture.waitForNextFrame()
                connection.send(Frame(bodies_of(capture.rigidBodies), time.monotonic()))
        except RuntimeError as error:  # all that the library raises
            connection.send(Failure(str(error)))


def bodies_of(found: Mapping[str, Any]) -> dict[str, Seen]:
    return {name: (_three(body.position), _four(body.rotation)) for name, body in found.items()}


def _three(position: Sequence[float]) -> tuple[float, float, float]:
    return float(position[0]), float(position[1]), float(position[2])


def _four(rotation: Any) -> tuple[float, float, float, float]:
    return float(rotation.w), float(rotation.x), float(rotation.y), float(rotation.z)
