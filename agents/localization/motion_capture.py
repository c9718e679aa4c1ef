"""Poses from outside: where motion capture, or another eye that is not on board, sees a drone, fused with its
vehicle's velocity.

Each pose corrects the estimate at the time at which it was true, and is believed where it is near enough to what the
estimate expects. It is not where another drone says to be: then two bodies were confused. Where none was believed for
a while, no single pose is: chance would bring a wrong one near enough. Then poses have to agree with each other and
with the velocity first.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from agents.localization.carrier import YAW, Carrier
from agents.localization.pose_filter import KEPT_TICKS, PoseFilter
from agents.vehicles.vehicle import SeenPose, Telemetry
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats, rotation_of_quaternion
from protocol.messages import ExternalPose
from protocol.mission import Mission
from protocol.news import Tell
from protocol.separation import SIGMAS

log = logging.getLogger(__name__)

LOCKSTEP_PATIENCE_S = 15.0
"""Wall time to wait for a pose in lockstep; less than what others wait for this drone."""
STRAY_S: Final = 0.25
"""A pose that was true so long before or after any tick that is remembered is of no use."""
AGREEING: Final = 3
"""So many poses at least must agree with each other before they are believed anew."""
START_SIGMAS: Final = 3.0
"""A drone stands within ``vehicles.start_tolerance_m`` of its start: that is so many deviations."""
START_SD_RAD: Final = 0.3
"""Of the yaw, as people put drones down."""
SILENT_S: Final = 0.5
"""After so long without a pose people are told."""


@dataclass(slots=True)
class PoseCounts:
    taken: int = 0
    """Poses that corrected the estimate ..."""
    refused: int = 0
    """... were too far from what it expects, ..."""
    others: int = 0
    """... lay where another drone is, ..."""
    doubted: int = 0
    """... came when none had been believed for a while, and did not yet agree with each other for long enough, ..."""
    late: int = 0
    """... or were of no tick that is remembered; ..."""
    unseen: int = 0
    """... and times that the body was not seen."""


@dataclass(slots=True)
class _Candidate:
    """Poses that agree with each other, though not with the estimate."""

    filter: PoseFilter
    since_s: float
    count: int = 1


class MotionCapture:
    """In lockstep poses are waited for and taken in their ticks, in real time as soon as they come."""

    def __init__(
        self,
        mission: Mission,
        drone: int,
        bus: Bus,
        *,
        lockstep: bool,
        now_s: Callable[[], float],
        aid: Callable[[SeenPose], None],
        others: Callable[[int], Floats],
        tell: Tell,
    ) -> None:
        """See `agents.localization.choice.make_pose_source`."""
        self._mission, self._bus, self._drone, self._lockstep = mission, bus, drone, lockstep
        self._now_s, self._aid, self._others, self._tell = now_s, aid, others, tell
        settings = mission.mocap
        expected_mps = mission.localization.velocity_error_mps
        self._carrier = Carrier(mission.tick_s, expected_mps, settings.deviation_m, settings.deviation_rad)
        self._waiting: deque[ExternalPose] = deque()
        """In lockstep, for their ticks."""
        self._moments: deque[tuple[int, float]] = deque(maxlen=KEPT_TICKS)
        """Ticks, and when they were."""
        self._candidate: _Candidate | None = None
        self._believed_s = self._seen_s = -math.inf
        self._silent = False
        self._resets = 0
        self.counts = PoseCounts()
        bus.on(topics.MOCAP, self._hear, drone)

    def prepare(self) -> None:
        """Nothing: who looks from outside is a process of its own."""

    def close(self) -> None:
        if self._moments:
            log.info("drone %d: motion capture: %s", self._drone, self.counts)

    def _hear(self, said: ExternalPose) -> None:
        if self._lockstep:
            self._waiting.append(said)
        elif said.age_s > topics.MOCAP.max_age_s:
            self.counts.late += 1
        else:
            self._take(said, self._now_s() - said.age_s)

    async def locate(self, tick: int, telemetry: Telemetry | None) -> Telemetry | None:
        """The vehicle's velocity carries the estimate to ``tick``; telemetry's age stays the vehicle's own."""
        if telemetry is None or not (np.isfinite(telemetry.pose).all() and np.isfinite(telemetry.velocity).all()):
            return telemetry  # the agent stops at that
        if self._lockstep:
            await self._wait_for_pose(tick)
        located = self._carry(tick, telemetry)
        if self._lockstep:
            self._take_due(tick)
        self._tell_silence()
        return self._carrier.fused(telemetry, located)

    async def _wait_for_pose(self, tick: int) -> None:
        if tick % self._mission.mocap_ticks or not self._moments:
            return
        if not await self._bus.until(lambda: any(said.tick >= tick for said in self._waiting), LOCKSTEP_PATIENCE_S):
            log.warning("drone %d: the pose of tick %d did not come: this run cannot be repeated", self._drone, tick)

    def _take_due(self, tick: int) -> None:
        """All of a tick that is not the first one, for which nobody waited."""
        while self._waiting and self._waiting[0].tick <= tick:
            said = self._waiting.popleft()
            if said.tick > self._moments[0][0]:
                self._take(said, said.tick * self._mission.tick_s - said.age_s)

    def _carry(self, tick: int, telemetry: Telemetry) -> PoseFilter:
        at_s = tick * self._mission.tick_s if self._lockstep else self._now_s()
        start_m = max(self._mission.vehicles.start_tolerance_m / START_SIGMAS, telemetry.position_sd_m)
        located = self._carrier.carry(tick, telemetry, start_m, max(START_SD_RAD, telemetry.angle_sd_rad))
        if not self._moments:
            self._believed_s = self._seen_s = at_s
        if not self._moments or tick > self._moments[-1][0]:
            self._moments.append((tick, at_s))
            if self._candidate is not None:
                self._candidate.filter.advance(tick, *located.step)
        return located

    # --- one pose ------------------------------------------------------------------------------------------------

    def _take(self, said: ExternalPose, true_s: float) -> None:
        seen = self._seen(said, true_s)
        if seen is None:
            self.counts.unseen += 1
            return
        self._seen_s = max(self._seen_s, true_s)
        located = self._carrier.filter
        if located is None:  # the vehicle's own estimator may need it to become ready
            self._aid(seen)
            return
        tick, at_s = min(self._moments, key=lambda moment: abs(moment[1] - true_s))
        if abs(true_s - at_s) > STRAY_S:
            self.counts.late += 1
        elif self._is_anothers(seen, tick):
            self.counts.others += 1
        elif self._is_believed(located, tick, seen, true_s - at_s):
            self._believed_s = true_s
            self._aid(replace(seen, resets=self._resets))

    def _seen(self, said: ExternalPose, true_s: float) -> SeenPose | None:
        if said.position is None or said.attitude is None:
            return None
        settings = self._mission.mocap
        return SeenPose(
            np.array(said.position),
            rotation_of_quaternion(said.attitude),
            said.position_sd_m or settings.deviation_m,
            said.angle_sd_rad or settings.deviation_rad,
            true_s,
        )

    def _is_anothers(self, seen: SeenPose, tick: int) -> bool:
        """Whether another drone may be there, by what it says of itself: drones keep farther apart than that."""
        others = self._others(tick)
        apart_m = np.linalg.norm(others[:, :3] - seen.position, axis=1)
        return bool((apart_m < self._mission.flight.separation_m / 2 + SIGMAS * others[:, 3]).any())

    def _is_believed(self, located: PoseFilter, tick: int, seen: SeenPose, after_s: float) -> bool:
        """``after_s``: how long after ``tick`` it was true."""
        pose, covariance = self._at_tick(located, seen, after_s)
        doubted = self._is_unsure(located) or seen.at_s - self._believed_s > self._mission.mocap.reacquire_s
        if doubted and not self._agrees(located, tick, pose, covariance, seen.at_s):
            self.counts.doubted += 1
            return False
        if not located.correct(tick, pose, covariance):
            self.counts.refused += 1
            return False
        self.counts.taken += 1
        self._candidate = None
        if doubted:
            self._resets += 1
            self._tell("info", "position", "taken from motion capture")
        return True

    def _is_unsure(self, located: PoseFilter) -> bool:
        """So that the drone holds."""
        return self._carrier.deviation_m(located) > self._mission.localization.deviation_max_m

    def _at_tick(self, located: PoseFilter, seen: SeenPose, after_s: float) -> tuple[Floats, Floats]:
        """Pose (4,) at the tick, and covariance (4, 4): the vehicle moved on with its velocity, or was faster or slower
        by what it can accelerate."""
        velocity = self._carrier.velocity.copy()
        velocity[:3] -= located.velocity_error
        pose = np.append(seen.position, math.atan2(seen.rotation[1, 0], seen.rotation[0, 0])) - after_s * velocity
        flight = self._mission.flight
        unknown_m = flight.acceleration_max_mps2 * after_s**2 / 2
        unknown_rad = flight.angular_acceleration_max_radps2 * after_s**2 / 2
        variance_m2 = seen.position_sd_m**2 + unknown_m**2
        return pose, np.diag([variance_m2] * 3 + [seen.angle_sd_rad**2 + unknown_rad**2])

    def _agrees(self, located: PoseFilter, tick: int, pose: Floats, covariance: Floats, true_s: float) -> bool:
        """Whether poses have agreed with each other, and with the velocity, for long enough."""
        candidate = self._candidate
        if candidate is None or not candidate.filter.correct(tick, pose, covariance):
            fresh = located.anew(tick, pose, math.sqrt(covariance[0, 0]), math.sqrt(covariance[YAW, YAW]))
            self._candidate = None if fresh is None else _Candidate(fresh, true_s)
            return False
        candidate.count += 1
        return true_s - candidate.since_s >= self._mission.mocap.reacquire_s and candidate.count >= AGREEING

    def _tell_silence(self) -> None:
        silent_s = self._moments[-1][1] - self._seen_s
        if self._silent == (silent_s > SILENT_S):
            return
        self._silent = not self._silent
        if self._silent:
            self._tell("warning", "position", f"not seen by motion capture for {silent_s:.1f} s")
        else:
            self._tell("info", "position", "seen by motion capture again")
