"""A vehicle of the internal simulator: telemetry comes with the clock's ticks, setpoints go back by topic."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from agents.vehicles.vehicle import Condition, Telemetry
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.messages import Setpoint, Tick
from protocol.mission import Flight

DOWN_M = 0.05
"""Below this height a vehicle that was told to land stands on the ground."""


class SimulatedVehicle:
    def __init__(self, bus: Bus, drone: int, flight: Flight, tick_s: float, now_s: Callable[[], float]) -> None:
        """``now_s``: the clock by which the agent judges silence."""
        self._bus, self._drone, self._tick_s, self._now_s = bus, drone, tick_s, now_s
        self._limit = np.array(flight.velocity_limits)
        self._telemetry: Telemetry | None = None
        self._tick = 0
        self._first_sent: int | None = None
        self._landing = False
        bus.on(topics.TICK, self._hear)

    def _hear(self, tick: Tick) -> None:
        for sample in tick.vehicles:
            if sample.drone == self._drone:
                self._telemetry = Telemetry(
                    np.array(sample.pose),
                    np.array(sample.velocity),
                    sample.battery,
                    self._now_s(),
                    self._delay_s(tick.tick, sample.setpoint_tick),
                    position_sd_m=sample.position_sd_m,
                    angle_sd_rad=sample.angle_sd_rad,
                )
                self._tick = tick.tick

    def _delay_s(self, tick: int, flown: int) -> float:
        """``flown``: tick of the setpoint in effect; those of an agent that flew this vehicle before do not count."""
        if self._first_sent is None:
            return 0.0
        return max(0, tick - 1 - max(flown, self._first_sent - 1)) * self._tick_s

    async def prepare(self) -> None:
        """Nothing: it hangs in the air at its start."""

    def take_off(self) -> None:
        """Nothing, likewise."""

    def condition(self) -> Condition:
        if not self._landing:
            return Condition("ours")
        height_m = math.inf if self._telemetry is None else float(self._telemetry.pose[2])
        return Condition("landed" if height_m < DOWN_M else "landing")

    def telemetry(self) -> Telemetry | None:
        return self._telemetry

    def send(self, tick: int, velocity: Floats) -> Floats:
        sent = np.clip(velocity, -self._limit, self._limit)
        if self._first_sent is None:
            self._first_sent = tick
        setpoint = Setpoint(drone=self._drone, tick=tick, velocity=tuple(sent.tolist()))
        self._bus.put(topics.SETPOINT, setpoint, self._drone)
        return sent

    def pass_tick(self, tick: int) -> None:
        self.send(tick, np.zeros(5))

    def stop(self) -> None:
        self.send(self._tick, np.zeros(5))

    def hold(self) -> None:
        self.stop()

    def land(self) -> None:
        self._landing = True
        setpoint = Setpoint(drone=self._drone, tick=self._tick, velocity=(0.0,) * 5, land=True)
        self._bus.put(topics.SETPOINT, setpoint, self._drone)

    def leave(self, *, hold: bool) -> None:  # noqa: ARG002  # either way
        """Stop: a simulated vehicle falls asleep where it is."""
        self.stop()

    def close(self) -> None:
        """Nothing to release: the bus belongs to the agent."""
