"""Where a drone's poses come from: what its agent asks each tick, whatever answers."""

from __future__ import annotations

from typing import Protocol

from agents.vehicles.vehicle import Telemetry


class PoseSource(Protocol):
    def prepare(self) -> None:
        """Before the flight.

        Raises:
            VehicleError: something that it takes is not there.
        """
        ...

    async def locate(self, tick: int, telemetry: Telemetry | None) -> Telemetry | None:
        """What the vehicle tells at ``tick``, with the best pose there is and its standard deviations. Asked once in
        each tick that something is decided in; in lockstep it waits for what is due by then."""
        ...

    def close(self) -> None:
        """May be called twice."""
        ...


class VehicleEstimate:
    """The vehicle's own: an autopilot's EKF, with or without motion capture behind it, or the simulator's."""

    def prepare(self) -> None:
        """Nothing: the vehicle checks itself."""

    async def locate(self, tick: int, telemetry: Telemetry | None) -> Telemetry | None:  # noqa: ARG002  # the protocol's
        return telemetry

    def close(self) -> None:
        """Nothing to release."""
