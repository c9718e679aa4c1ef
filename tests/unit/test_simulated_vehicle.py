"""The internal simulator's vehicle and clock, by a bus that only notes what passes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest

from agents.vehicles.simulated import SimulatedVehicle
from protocol import topics
from protocol.bus import Bus
from protocol.clock import SIMULATOR_PATIENCE_S, SimulatorClock
from protocol.messages import Setpoint, Tick, VehicleSample
from protocol.mission import Flight
from protocol.topics import Topic

FLIGHT = Flight(speed_max_mps=0.5, turn_rate_max_radps=0.4)


@dataclass
class NotingBus:
    """Hands ticks to whoever listens, and keeps what is put."""

    put_by: list[tuple[str, Setpoint, str]] = field(default_factory=list)
    handlers: list[Callable[[Tick], None]] = field(default_factory=list)
    alive: set[str] = field(default_factory=set)

    def on(self, topic: Topic[Any], handler: Callable[[Tick], None]) -> None:
        assert topic is topics.TICK
        self.handlers.append(handler)

    def put(self, topic: Topic[Any], message: Setpoint, drone: int) -> None:
        self.put_by.append((topic.of(drone), message, threading.current_thread().name))

    async def until(self, condition: Callable[[], bool], _timeout_s: float) -> bool:
        return condition()

    def beat(self, number: int, flown: int = -1) -> None:
        for handler in self.handlers:
            handler(tick(number, flown))


def tick(number: int, flown: int = -1) -> Tick:
    samples = [
        VehicleSample(
            drone=drone,
            pose=(drone, number, 2.0, 0.0, 1.3),
            velocity=(0.1 * drone, 0.0, 0.0, 0.0, 0.0),
            battery=0.5,
            setpoint_tick=flown,
        )
        for drone in (1, 2)
    ]
    return Tick(
        tick=number,
        time_s=0.05 * number,
        lockstep=True,
        live=(1, 2),
        vehicles=tuple(samples),
        jump_epoch=1,
        next_jump=0,
        keyframes=0,
    )


@pytest.fixture
def bus() -> NotingBus:
    return NotingBus()


@pytest.fixture
def vehicle(bus: NotingBus) -> SimulatedVehicle:
    return SimulatedVehicle(cast("Bus", bus), 2, FLIGHT, 0.05, lambda: 12.5)


def test_there_is_no_telemetry_before_the_first_tick(vehicle: SimulatedVehicle) -> None:
    assert vehicle.telemetry() is None


def test_telemetry_is_the_newest_of_the_own_drone(bus: NotingBus, vehicle: SimulatedVehicle) -> None:
    bus.beat(3)
    bus.beat(4)

    telemetry = vehicle.telemetry()

    assert telemetry is not None
    assert telemetry.pose.tolist() == [2.0, 4.0, 2.0, 0.0, 1.3]
    assert telemetry.velocity.tolist() == [0.2, 0.0, 0.0, 0.0, 0.0]
    assert (telemetry.battery, telemetry.stamp_s) == (0.5, 12.5)


def test_what_is_sent_is_clipped_and_told(bus: NotingBus, vehicle: SimulatedVehicle) -> None:
    sent = vehicle.send(7, np.array([9.0, -0.3, -9.0, 9.0, 0.1]))

    assert sent.tolist() == [0.5, -0.3, -0.5, 0.4, 0.1]
    ((key, setpoint, _),) = bus.put_by
    assert key == "drone/2/setpoint"
    assert (setpoint.tick, setpoint.velocity) == (7, tuple(sent.tolist()))


@pytest.mark.parametrize(("flown", "delay_s"), [(9, 0.0), (8, 0.05), (3, 0.3)])
def test_telemetry_tells_how_long_a_command_takes_beyond_a_tick(
    bus: NotingBus, vehicle: SimulatedVehicle, flown: int, delay_s: float
) -> None:
    vehicle.send(1, np.zeros(5))
    bus.beat(10, flown)

    telemetry = vehicle.telemetry()
    assert telemetry is not None
    assert telemetry.delay_s == pytest.approx(delay_s)


def test_commands_of_an_agent_that_flew_the_vehicle_before_tell_no_delay(
    bus: NotingBus, vehicle: SimulatedVehicle
) -> None:
    bus.beat(100, flown=20)
    vehicle.send(100, np.zeros(5))
    bus.beat(102, flown=20)

    telemetry = vehicle.telemetry()
    assert telemetry is not None
    assert telemetry.delay_s == pytest.approx(0.1), "its own first command takes two ticks already"


def test_landing_is_told_with_the_newest_tick(bus: NotingBus, vehicle: SimulatedVehicle) -> None:
    bus.beat(9)
    vehicle.land()

    ((_, setpoint, _),) = bus.put_by
    assert (setpoint.tick, setpoint.land, setpoint.velocity) == (9, True, (0.0,) * 5)


def test_any_thread_may_stop_the_vehicle(bus: NotingBus, vehicle: SimulatedVehicle) -> None:
    bus.beat(9)
    other = threading.Thread(target=vehicle.stop, name="other")
    other.start()
    other.join()

    ((_, setpoint, thread),) = bus.put_by
    assert (setpoint.drone, setpoint.tick, setpoint.velocity) == (2, 9, (0.0,) * 5)
    assert thread == "other"


def test_it_may_be_closed_twice(vehicle: SimulatedVehicle) -> None:
    vehicle.close()
    vehicle.close()


async def test_the_clock_gives_ticks_in_order_and_tells_how_many_wait(bus: NotingBus) -> None:
    clock = SimulatorClock(cast("Bus", bus), lockstep=True)
    assert await clock.next_tick(0.0) is None

    for number in (0, 1, 2):
        bus.beat(number)
    first = await clock.next_tick(0.0)

    assert first is not None
    assert first.tick == 0
    assert clock.backlog == 2
    assert [(await clock.next_tick(0.0)).tick for _ in range(2)] == [1, 2]  # type: ignore[union-attr]
    assert clock.backlog == 0


async def test_a_tick_that_is_said_again_or_late_counts_once(bus: NotingBus) -> None:
    clock = SimulatorClock(cast("Bus", bus), lockstep=True)
    for number in (0, 1, 1, 3, 2, 3):
        bus.beat(number)

    assert [(await clock.next_tick(0.0)).tick for _ in range(3)] == [0, 1, 3]  # type: ignore[union-attr]
    assert clock.backlog == 0


async def test_a_simulator_is_given_up_when_it_is_neither_heard_nor_seen_in_a_long_wait(bus: NotingBus) -> None:
    clock = SimulatorClock(cast("Bus", bus), lockstep=False)
    await clock.next_tick(SIMULATOR_PATIENCE_S)
    assert not clock.is_gone, "not before it was there"
    bus.beat(0)
    await clock.next_tick(0.0)
    await clock.next_tick(SIMULATOR_PATIENCE_S)
    assert not clock.is_gone
    await clock.next_tick(0.1)
    assert clock.is_gone
    bus.alive.add("sim")
    assert not clock.is_gone
    bus.alive.clear()
    bus.beat(1)
    assert not clock.is_gone


async def test_a_process_that_slept_does_not_take_its_sleep_for_the_simulators_silence(bus: NotingBus) -> None:
    now_s = 100.0
    clock = SimulatorClock(cast("Bus", bus), lockstep=False, now_s=lambda: now_s)
    bus.beat(0)
    await clock.next_tick(0.0)
    now_s += 10 * SIMULATOR_PATIENCE_S
    assert await clock.next_tick(0.2) is None
    assert not clock.is_gone


async def test_in_lockstep_time_is_the_missions_and_stands_still_between_ticks(bus: NotingBus) -> None:
    clock = SimulatorClock(cast("Bus", bus), lockstep=True)
    bus.beat(40)

    assert [clock.now_s() for _ in range(3)] == [2.0, 2.0, 2.0]


async def test_in_real_time_it_is_the_machines(bus: NotingBus) -> None:
    clock = SimulatorClock(cast("Bus", bus), lockstep=False)
    bus.beat(40)

    before = time.monotonic()
    assert before <= clock.now_s() <= time.monotonic()
