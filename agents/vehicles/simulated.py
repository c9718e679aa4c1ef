"""A vehicle of the internal simulator: telemetry comes with the clock's ticks, setpoints go back by topic."""

from __future__ import annotations

import numpy as np

from agents.vehicles.vehicle import Telemetry
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.messages import Setpoint, Tick
from protocol.mission import Flight


class SimulatedVehicle:
    def __init__(self, bus: Bus, drone: int, flight: Flight) -> None:
        self._bus, self._drone = bus, drone
        self._limit = np.array(flight.velocity_limits)
        self._telemetry: Telemetry | None = None
        self._tick = 0
        bus.on(topics.TICK, self._hear)

    def _hear(self, tick: Tick) -> None:
        for sample in tick.vehicles:
            if sample.drone == self._drone:
                self._telemetry = Telemetry(
                    np.array(sample.pose), np.array(sample.velocity), sample.battery, tick.time_s
                )
                self._tick = tick.tick

    def telemetry(self) -> Telemetry | None:
        return self._telemetry

    def send(self, tick: int, velocity: Floats) -> Floats:
        sent = np.clip(velocity, -self._limit, self._limit)
        self._bus.put(
            topics.SETPOINT, Setpoint(drone=self._drone, tick=tick, velocity=tuple(sent.tolist())), self._drone
        )
        return sent

    def stop(self) -> None:
        self.send(self._tick, np.zeros(5))

    def close(self) -> None:
        """Nothing to release: the bus belongs to the agent."""
