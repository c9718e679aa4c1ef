"""Motion capture's poses in a drone's process: what is believed, when, and what is told without them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import numpy as np
import pytest

from agents.localization.choice import make_pose_source
from agents.localization.motion_capture import SILENT_S, MotionCapture
from agents.vehicles.vehicle import SeenPose, Telemetry
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.localization_settings import Localization
from protocol.messages import EventLevel, ExternalPose
from protocol.mission import Drone, Mission

START = (0.0, 1.0, 2.0, 0.3, 1.3)
MISSION = Mission(localization=Localization(source="mocap"), drones=(Drone(id=2, start=START),))
TICK_S = MISSION.tick_s
REACQUIRE_TICKS = round(MISSION.mocap.reacquire_s / TICK_S)
UNSURE_M = MISSION.localization.deviation_max_m


class OneHandlerBus:
    def on(self, topic: object, handler: Callable[[ExternalPose], None], drone: int) -> None:
        assert topic is topics.MOCAP
        assert drone == 2
        self.deliver = handler

    async def until(self, condition: Callable[[], bool], _timeout_s: float) -> bool:
        return condition()


@dataclass
class Flown:
    """A drone whose vehicle believes to stand where it starts, whatever is true."""

    lockstep: bool = True
    others: Floats = field(default_factory=lambda: np.zeros((0, 4)))
    now_s: float = 0.0
    aided: list[SeenPose] = field(default_factory=list)
    told: list[tuple[EventLevel, str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.bus = OneHandlerBus()
        source = make_pose_source(
            MISSION,
            2,
            cast("Bus", self.bus),
            lockstep=self.lockstep,
            now_s=lambda: self.now_s,
            aid=self.aided.append,
            others=lambda _tick: self.others,
            tell=lambda level, kind, text: self.told.append((level, kind, text)),
        )
        assert isinstance(source, MotionCapture)
        self.source = source

    def see(self, tick: int, x: float = 0.0, *, yaw: float = 0.3, late_ticks: float = 0, seen: bool = True) -> None:
        half = yaw / 2
        where = {"position": (x, 1.0, 2.0), "attitude": (math.cos(half), 0.0, 0.0, math.sin(half))} if seen else {}
        self.bus.deliver(ExternalPose(drone=2, tick=tick, age_s=late_ticks * TICK_S, **where))

    async def tick(self, tick: int, speed: float = 0.0) -> Telemetry:
        self.now_s = tick * TICK_S
        telemetry = Telemetry(np.array(START), np.array([speed, 0.0, 0.0, 0.0, 0.0]), 1.0, self.now_s)
        located = await self.source.locate(tick, telemetry)
        assert located is not None
        return located

    async def settle(self) -> int:
        """Until it knows where it is, at x = 0; the last tick."""
        for tick in range(REACQUIRE_TICKS + 3):
            self.see(tick)
            located = await self.tick(tick)
        assert located.position_sd_m < 0.01
        return tick


# --- the beginning ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lockstep", [True, False])
async def test_a_drone_is_unsure_until_poses_have_agreed_for_long_enough_and_then_knows_its_place(
    lockstep: bool,
) -> None:
    flown = Flown(lockstep)
    deviations = []
    for tick in range(REACQUIRE_TICKS + 3):
        if lockstep:
            flown.see(tick, 0.2, yaw=0.4)
        deviations.append((located := await flown.tick(tick)).position_sd_m)
        if not lockstep:
            flown.see(tick, 0.2, yaw=0.4)
    assert all(deviation > UNSURE_M for deviation in deviations[:REACQUIRE_TICKS])
    assert deviations[-1] < 0.02
    assert located.pose.tolist() == pytest.approx([0.2, 1.0, 2.0, 0.4, 1.3], abs=1e-3)
    assert located.stamp_s == pytest.approx(flown.now_s), "the vehicle's own"


async def test_without_any_pose_it_stays_unsure_and_says_that_it_is_not_seen() -> None:
    flown = Flown(lockstep=False)
    told = [(await flown.tick(tick)).position_sd_m for tick in range(30)]
    assert min(told) > UNSURE_M
    assert [kind for _, kind, _ in flown.told] == ["position"]
    assert "not seen by motion capture" in flown.told[0][2]


async def test_before_the_first_tick_poses_help_the_vehicle_s_own_estimator_to_become_ready() -> None:
    flown = Flown(lockstep=False)
    flown.see(0, 0.5)
    assert [seen.position.tolist() for seen in flown.aided] == [[0.5, 1.0, 2.0]]
    assert flown.source.counts.taken == 0


async def test_a_body_out_of_the_drone_s_reach_is_not_where_it_starts() -> None:
    flown = Flown()
    for tick in range(4 * REACQUIRE_TICKS):
        flown.see(tick, 5.0)
        located = await flown.tick(tick)
        if tick < REACQUIRE_TICKS:
            assert located.pose[0] == 0.0
    assert located.pose[0] == 0.0
    assert located.position_sd_m > UNSURE_M


# --- in flight -------------------------------------------------------------------------------------------------------


async def test_a_pose_corrects_the_estimate_at_the_time_at_which_it_was_true() -> None:
    """A late one of a moving drone is no surprise, nor one from between two ticks."""
    flown = Flown(lockstep=False)
    for tick in range(60):
        located = await flown.tick(tick, speed=0.4)
        flown.see(tick, 0.4 * (tick - 2.5) * TICK_S, late_ticks=2.5)
    assert located.pose[0] == pytest.approx(0.4 * 59 * TICK_S, abs=0.003)
    assert flown.source.counts.refused == 0


async def test_the_vehicle_s_velocity_is_freed_of_its_slow_error() -> None:
    flown = Flown()
    for tick in range(200):
        flown.see(tick)
        located = await flown.tick(tick, speed=0.05)
    assert located.pose[0] == pytest.approx(0.0, abs=0.002)
    assert located.velocity[0] == pytest.approx(0.0, abs=0.015)


async def test_a_body_that_jumps_is_not_believed_and_the_vehicle_s_estimator_does_not_hear_of_it() -> None:
    flown = Flown()
    last = await flown.settle()
    heard, taken = len(flown.aided), flown.source.counts.taken
    for tick in range(last + 1, last + 41):
        flown.see(tick, 1.5)
        located = await flown.tick(tick)
    assert located.pose[0] == pytest.approx(0.0, abs=0.01)
    assert flown.source.counts.taken == taken
    assert len(flown.aided) == heard


async def test_without_poses_the_deviation_grows_and_a_body_that_comes_back_is_believed_once_it_agrees() -> None:
    flown = Flown()
    last = await flown.settle()
    tick, deviation_m = last, 0.0
    while deviation_m <= UNSURE_M:
        tick += 1
        flown.see(tick, seen=False)
        deviation_m = (await flown.tick(tick)).position_sd_m
    assert 2.0 < (tick - last) * TICK_S < 10.0
    came, count = tick, flown.source.counts.taken
    while deviation_m > UNSURE_M:
        tick += 1
        flown.see(tick, 0.7)
        located = await flown.tick(tick)
        deviation_m = located.position_sd_m
    assert tick - came == pytest.approx(REACQUIRE_TICKS + 1, abs=1)
    assert located.pose[0] == pytest.approx(0.7, abs=0.01)
    assert flown.source.counts.taken == count + 1
    assert flown.aided[-1].resets == 2, "the first time was the start"


async def test_poses_that_do_not_fit_the_velocity_are_never_believed_again() -> None:
    """Another body, which flies differently."""
    flown = Flown()
    last = await flown.settle()
    for tick in range(last + 1, last + 400):
        flown.see(tick, 0.5 + 0.4 * math.sin(0.15 * tick))
        located = await flown.tick(tick)
    assert located.position_sd_m > UNSURE_M
    assert flown.aided[-1].resets == 1


async def test_a_body_where_another_drone_is_is_that_drone_s_however_unsure_this_one_is() -> None:
    flown = Flown()
    last = await flown.settle()
    flown.others = np.array([[0.9, 1.0, 2.0, 0.0]])
    for tick in range(last + 1, last + 400):
        flown.see(tick, 0.9)
        located = await flown.tick(tick)
    assert located.pose[0] == pytest.approx(0.0, abs=0.01)
    assert flown.source.counts.others == 399
    assert flown.source.counts.refused == 0


async def test_in_lockstep_poses_that_come_before_their_turn_wait_for_it() -> None:
    early, in_time = Flown(), Flown()
    for tick in range(40):
        early.see(tick, 0.01 * tick)
    for tick in range(40):
        in_time.see(tick, 0.01 * tick)
        one, other = await early.tick(tick, speed=0.2), await in_time.tick(tick, speed=0.2)
        assert one.pose.tolist() == other.pose.tolist()
    assert early.source.counts == in_time.source.counts


async def test_in_real_time_a_pose_that_is_too_old_is_counted_and_left_out() -> None:
    flown = Flown(lockstep=False)
    await flown.tick(0)
    flown.see(0, late_ticks=topics.MOCAP.max_age_s / TICK_S + 1)
    assert flown.source.counts.late == 1


async def test_people_are_told_once_that_a_body_is_lost_and_once_that_it_is_back() -> None:
    flown = Flown()
    last = await flown.settle()
    flown.told.clear()
    gap = round(SILENT_S / TICK_S) + 5
    for tick in range(last + 1, last + gap):
        flown.see(tick, seen=False)
        await flown.tick(tick)
    for tick in range(last + gap, last + gap + 10):
        flown.see(tick)
        await flown.tick(tick)
    assert [level for level, _, _ in flown.told] == ["warning", "info"]
    assert flown.source.counts.unseen == gap - 1


async def test_the_images_of_a_camera_fixed_to_the_airframe_turn_with_the_yaw_that_was_seen() -> None:
    flown = Flown()
    for tick in range(REACQUIRE_TICKS + 5):
        flown.see(tick, yaw=0.4)
        telemetry = Telemetry(np.array(START), np.zeros(5), 1.0, 0.0, rotation=np.eye(3))
        located = await flown.source.locate(tick, telemetry)
    assert located is not None
    assert located.rotation is not None
    assert math.atan2(located.rotation[1, 0], located.rotation[0, 0]) == pytest.approx(0.1, abs=0.005)


async def test_telemetry_that_is_not_sound_is_left_to_who_stops_at_it() -> None:
    flown = Flown()
    assert await flown.source.locate(0, None) is None
    broken = Telemetry(np.full(5, np.nan), np.zeros(5), 1.0, 0.0)
    assert await flown.source.locate(1, broken) is broken
