"""A lidar's poses in a drone's process: when scans are taken, what happens without them, and what is told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from agents.localization.choice import make_pose_source
from agents.localization.lidar import EFFECT_TICKS, LidarOdometry
from agents.localization.pose_source import VehicleEstimate
from agents.localization.registrar import Job
from agents.localization.registration import Registration
from agents.vehicles.vehicle import Telemetry
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.localization_settings import Localization
from protocol.messages import LidarScan
from protocol.mission import Drone, Mission

MISSION = Mission(localization=Localization(source="lidar"), drones=(Drone(id=2, start=(0.0, 1.0, 2.0, 0.0, 1.3)),))
GOOD = np.diag([0.01**2] * 3 + [0.003**2])


class OneHandlerBus:
    def __init__(self) -> None:
        self.statistics = SimpleNamespace(refused=Counter[str]())

    def on(self, topic: object, handler: Callable[[LidarScan], None], drone: int) -> None:
        assert topic is topics.SCAN
        assert drone == 2
        self.deliver = handler

    async def until(self, condition: Callable[[], bool], _timeout_s: float) -> bool:
        return condition()


@dataclass
class ScriptedRegistrar:
    """Answers when it is told to: with the guess, shifted."""

    jobs: list[Job] = field(default_factory=list)
    futures: list[Future[Registration]] = field(default_factory=list)
    at_once: bool = True
    shift: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    overlap: float = 0.9

    def start(self) -> None:
        pass

    def close(self) -> None:
        pass

    def submit(self, job: Job) -> Future[Registration]:
        self.jobs.append(job)
        self.futures.append(Future())
        if self.at_once:
            self.answer()
        return self.futures[-1]

    def answer(self) -> None:
        pose = self.jobs[-1].guess + self.shift
        self.futures[-1].set_result(Registration(pose, GOOD, self.overlap, 0.0))


@dataclass
class Flown:
    registrar: ScriptedRegistrar = field(default_factory=ScriptedRegistrar)
    lockstep: bool = True

    def __post_init__(self) -> None:
        self.bus = OneHandlerBus()
        self.source = LidarOdometry(MISSION, 2, cast("Bus", self.bus), lockstep=self.lockstep, registrar=self.registrar)

    def scan(self, tick: int) -> None:
        self.bus.deliver(LidarScan(drone=2, tick=tick, points=np.full((5, 3), tick, np.int16)))

    async def tick(self, tick: int, x: float = 0.0, speed: float = 0.0) -> Telemetry:
        telemetry = Telemetry(vector(x, 1.0, 2.0, 0.0, 1.3), vector(speed, 0.0, 0.0, 0.0, 0.0), 1.0, 0.05 * tick)
        located = await self.source.locate(tick, telemetry)
        assert located is not None
        return located


def vector(*values: float) -> Floats:
    return np.array(values)


async def test_the_vehicle_s_own_estimate_is_passed_on_as_it_is() -> None:
    source = make_pose_source(MISSION.model_copy(update={"localization": Localization()}), 2, Any, lockstep=True)
    telemetry = Telemetry(np.zeros(5), np.zeros(5), 1.0, 0.0)
    assert isinstance(source, VehicleEstimate)
    assert await source.locate(1, telemetry) is telemetry
    assert await source.locate(2, None) is None


async def test_it_begins_where_the_vehicle_says_and_goes_on_by_its_velocity_alone() -> None:
    flown = Flown()
    first = await flown.tick(0, x=0.5)
    assert first.pose.tolist() == pytest.approx([0.5, 1.0, 2.0, 0.0, 1.3])
    later = await flown.tick(1, x=7.0, speed=0.4)
    assert later.pose[0] == pytest.approx(0.5 + 0.05 * 0.2), "the mean of both velocities; not the vehicle's place"
    assert later.pose[4] == 1.3, "the gimbal's"
    assert later.stamp_s == 0.05


async def test_in_lockstep_every_scan_has_its_effect_in_its_own_tick_however_early_it_is_there() -> None:
    flown = Flown(ScriptedRegistrar(shift=(0.01, 0.0, 0.0, 0.0)))
    places = []
    for tick in range(6):
        if tick % MISSION.scan_ticks == 0:
            flown.scan(tick)
        places.append((await flown.tick(tick)).pose[0])
    assert [job.points[0, 0] for job in flown.registrar.jobs] == [0, 2, 4]
    assert places[:EFFECT_TICKS] == [0.0] * EFFECT_TICKS
    assert 0.0 < places[2] == places[3] < places[4]
    assert flown.source.counts.taken == 2


async def test_in_lockstep_scans_that_come_before_their_turn_wait_for_it() -> None:
    flown = Flown()
    flown.scan(0)
    flown.scan(2)
    for tick in range(4):
        await flown.tick(tick)
    assert [job.points[0, 0] for job in flown.registrar.jobs] == [0, 2]
    assert flown.source.counts.missed == 0


async def test_in_real_time_nobody_waits_and_the_newest_scan_is_taken_next() -> None:
    flown = Flown(ScriptedRegistrar(at_once=False), lockstep=False)
    await flown.tick(0)
    flown.scan(0)
    await flown.tick(1)
    for tick in range(2, 8):
        flown.scan(tick)
        await flown.tick(tick)
    assert [job.points[0, 0] for job in flown.registrar.jobs] == [0]
    flown.registrar.answer()
    await flown.tick(8)
    assert [job.points[0, 0] for job in flown.registrar.jobs] == [0, 7]
    assert flown.source.counts.missed == 5
    assert flown.source.counts.taken == 1


async def test_a_scan_that_was_taken_enters_the_map_where_it_was_and_a_refused_one_never() -> None:
    flown = Flown()
    for tick in range(8):
        flown.registrar.overlap = 0.2 if tick == 3 else 0.9
        if tick % 2 == 0:
            flown.scan(tick)
        await flown.tick(tick)
    kept = [job.kept is not None for job in flown.registrar.jobs]
    assert kept == [False, True, False, True]
    assert flown.source.counts.refused == 1


async def test_without_scans_the_deviation_grows_until_a_policy_ends_the_flight() -> None:
    flown = Flown(lockstep=False)
    told = [(await flown.tick(tick)).position_sd_m for tick in range(200)]
    assert told == sorted(told)
    assert told[0] < 0.02
    assert told[-1] > MISSION.localization.deviation_max_m


async def test_a_registrar_that_died_is_told_once_and_the_flight_goes_on_by_velocity(
    caplog: pytest.LogCaptureFixture,
) -> None:
    flown = Flown(ScriptedRegistrar(at_once=False))
    await flown.tick(0)
    flown.scan(0)
    await flown.tick(1)
    flown.registrar.futures[0].set_exception(EOFError("gone"))
    for tick in range(2, 10):
        if tick % 2 == 0:
            flown.scan(tick)
        await flown.tick(tick)
    assert len(flown.registrar.jobs) == 1
    assert caplog.text.count("registered no longer") == 1


async def test_telemetry_that_is_not_sound_is_left_to_who_stops_at_it() -> None:
    flown = Flown()
    assert await flown.source.locate(0, None) is None
    broken = Telemetry(np.full(5, np.nan), np.zeros(5), 1.0, 0.0)
    assert await flown.source.locate(1, broken) is broken


async def test_points_of_another_shape_are_refused_and_counted() -> None:
    flown = Flown()
    flown.bus.deliver(LidarScan(drone=2, tick=0, points=np.zeros((5, 2), np.int16)))
    flown.bus.deliver(LidarScan(drone=2, tick=0, points=np.zeros((5, 3), np.float32)))
    assert flown.bus.statistics.refused[topics.SCAN.key] == 2
    await flown.tick(0)
    assert not flown.registrar.jobs
