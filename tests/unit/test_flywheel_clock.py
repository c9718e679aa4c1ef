"""The clock of vehicles that fly by themselves: it follows beats, and goes on without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import pytest

from protocol.bus import Bus
from protocol.clock import FlywheelClock, SimulatorClock, clock_of
from protocol.messages import Tick
from protocol.mission import Drone, Mission
from protocol.vehicle_settings import Vehicles

TICK_S = 0.05
MISSION = Mission(drones=(Drone(id=1, start=(0.0, 0.0, 2.0, 0.0, 1.3)),))


class ScriptedBus:
    """Waiting costs time, and beats come at theirs."""

    def __init__(self) -> None:
        self.now_s = 50.0
        self.beats: list[tuple[float, Tick]] = []
        self.alive: set[str] = set()

    def on(self, _topic: object, handler: Callable[[Tick], None]) -> None:
        self.handler = handler

    async def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        end_s = self.now_s + timeout_s
        while not condition():
            due = [entry for entry in self.beats if entry[0] <= end_s]
            if not due:
                self.now_s = end_s
                return False
            self.beats.remove(due[0])
            self.now_s = max(self.now_s, due[0][0])
            self.handler(due[0][1])
        return True


def beat(number: int) -> Tick:
    return Tick(
        tick=number,
        time_s=number * TICK_S,
        lockstep=False,
        live=(1, 4),
        vehicles=(),
        jump_epoch=9,
        next_jump=3,
        keyframes=7,
    )


@pytest.fixture
def bus() -> ScriptedBus:
    return ScriptedBus()


@pytest.fixture
def clock(bus: ScriptedBus) -> FlywheelClock:
    return FlywheelClock(cast("Bus", bus), TICK_S, lambda: bus.now_s)


async def numbers(clock: FlywheelClock, count: int) -> list[int]:
    ticks = [await clock.next_tick(1.0) for _ in range(count)]
    return [tick.tick for tick in ticks if tick is not None]


async def test_nothing_begins_before_the_first_beat(bus: ScriptedBus, clock: FlywheelClock) -> None:
    assert await clock.next_tick(5.0) is None
    assert bus.now_s == 55.0
    assert not clock.is_gone


async def test_beats_are_followed_with_their_jitter(bus: ScriptedBus, clock: FlywheelClock) -> None:
    bus.beats = [(51.0 + TICK_S * k + late, beat(k)) for k, late in enumerate((0.0, 0.02, 0.0, 0.024, 0.0))]
    assert await numbers(clock, 5) == [0, 1, 2, 3, 4]
    assert bus.now_s == pytest.approx(51.2)


async def test_without_beats_ticks_go_on_at_their_rate(bus: ScriptedBus, clock: FlywheelClock) -> None:
    bus.beats = [(51.0, beat(10))]
    assert await numbers(clock, 21) == list(range(10, 31))
    assert bus.now_s == pytest.approx(51.0 + 20 * TICK_S + TICK_S / 2)
    last = await clock.next_tick(1.0)
    assert last is not None
    assert (last.live, last.jump_epoch, last.next_jump) == ((1, 4), 9, 3)
    assert last.time_s == pytest.approx(31 * TICK_S)


async def test_no_tick_comes_twice_when_the_beats_are_back(bus: ScriptedBus, clock: FlywheelClock) -> None:
    bus.beats = [(51.0, beat(0)), (51.0 + 2.8 * TICK_S, beat(2)), (51.0 + 3 * TICK_S, beat(3)), (51.2, beat(4))]
    assert await numbers(clock, 5) == [0, 1, 2, 3, 4]


async def test_one_that_slept_passes_over_what_is_past(bus: ScriptedBus, clock: FlywheelClock) -> None:
    bus.beats = [(51.0, beat(0))]
    assert await numbers(clock, 1) == [0]
    bus.now_s += 10.0
    assert await numbers(clock, 2) == [199, 200]
    assert clock.backlog == 0


def test_each_kind_of_vehicle_has_its_clock(bus: ScriptedBus) -> None:
    px4 = MISSION.model_copy(update={"vehicles": Vehicles(kind="px4")})
    assert isinstance(clock_of(MISSION, cast("Bus", bus), lockstep=True), SimulatorClock)
    assert isinstance(clock_of(px4, cast("Bus", bus), lockstep=False), FlywheelClock)
