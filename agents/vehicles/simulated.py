"""A vehicle of the internal simulator: telemetry comes with the clock's ticks, setpoints go back by topic."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agents.vehicles.vehicle import Authority, Condition, SeenPose, Telemetry
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.messages import Setpoint, Tick, VehicleSample
from protocol.mission import Flight

DOWN_M = 0.05
"""Below this height a vehicle that was told to land stands on the ground."""
CLIMB_MPS, APPROACH_PER_S = 0.5, 0.8
"""How it climbs to its start's height: so fast at most, and slower in the last metres."""
UP_M = 0.1
"""So far below that height a climb has ended."""


class SimulatedVehicle:
    def __init__(
        self, bus: Bus, drone: int, flight: Flight, tick_s: float, now_s: Callable[[], float], start_m: float = 0.0
    ) -> None:
        """``now_s``: the clock by which the agent judges silence; ``start_m``: world z to climb to."""
        self._bus, self._drone, self._tick_s, self._now_s, self._start_m = bus, drone, tick_s, now_s, start_m
        self._limit = np.array(flight.velocity_limits)
        self._telemetry: Telemetry | None = None
        self._tick = 0
        self._first_sent: int | None = None
        self._authority: Authority = "ours"
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
                self._advance(sample, down=self._drone in tick.aground)

    def _advance(self, sample: VehicleSample, *, down: bool) -> None:
        """What the vehicle has come to by itself. It cannot stay up without a battery. ``down``: it stands on the
        ground, as the simulator says."""
        height_m = sample.pose[2]
        if self._authority in ("starting", "ours") and sample.battery == 0:
            self._authority = "landing"
        touches = (sample.truth or sample.pose)[2] < DOWN_M  # felt, whatever it takes its height for
        if (self._authority == "landing" and touches) or (self._authority in ("landing", "ours") and down):
            self._authority = "landed"
        if self._authority == "starting" and height_m > self._start_m - UP_M:
            self._authority = "ours"

    def _delay_s(self, tick: int, flown: int) -> float:
        """``flown``: tick of the setpoint in effect; those of an agent that flew this vehicle before do not count."""
        if self._first_sent is None:
            return 0.0
        return max(0, tick - 1 - max(flown, self._first_sent - 1)) * self._tick_s

    async def prepare(self) -> None:
        """Nothing: it hangs in the air at its start."""

    def take_off(self) -> None:
        """Nothing, likewise; but for one that was made ready."""
        if self._authority == "ready":
            self._authority = "starting"

    def make_ready(self) -> bool:
        if self._authority != "landed":
            return False
        self._authority = "ready"
        return True

    def condition(self) -> Condition:
        return Condition(self._authority)

    def telemetry(self) -> Telemetry | None:
        return self._telemetry

    def send(self, tick: int, velocity: Floats) -> Floats:
        sent = np.clip(velocity, -self._limit, self._limit)
        self._send(tick, sent)
        return sent

    def _send(self, tick: int, velocity: Floats, *, take_off: bool = False) -> None:
        if self._first_sent is None:
            self._first_sent = tick
        setpoint = Setpoint(drone=self._drone, tick=tick, velocity=tuple(velocity.tolist()), take_off=take_off)
        self._bus.put(topics.SETPOINT, setpoint, self._drone)

    def pass_tick(self, tick: int) -> None:
        if self._authority == "starting" and self._telemetry is not None:
            left_m = max(0.0, self._start_m - float(self._telemetry.pose[2]))
            climb = np.array([0.0, 0.0, min(CLIMB_MPS, APPROACH_PER_S * left_m), 0.0, 0.0])
            self._send(tick, np.clip(climb, -self._limit, self._limit), take_off=True)
        else:
            self.send(tick, np.zeros(5))

    def aid(self, seen: SeenPose) -> None:
        """Nothing: its estimate is the simulator's."""

    def stop(self) -> None:
        self.send(self._tick, np.zeros(5))

    def hold(self) -> None:
        self.stop()

    def land(self) -> None:
        if self._authority in ("starting", "ours"):
            self._authority = "landing"
        setpoint = Setpoint(drone=self._drone, tick=self._tick, velocity=(0.0,) * 5, land=True)
        self._bus.put(topics.SETPOINT, setpoint, self._drone)

    def leave(self, *, hold: bool) -> None:  # noqa: ARG002  # either way
        """Stop: a simulated vehicle falls asleep where it is."""
        self.stop()

    def close(self) -> None:
        """Nothing to release: the bus belongs to the agent."""
