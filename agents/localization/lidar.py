"""Poses from a lidar: scans fitted to the map that they make, fused with the vehicle's velocity from a known start on.

Scans are registered in a process of their own (`agents.localization.registrar`), one at a time; of those that come
meanwhile the newest is taken next. In lockstep every scan is taken, and each corrects the estimate exactly
`EFFECT_TICKS` after its own tick, however fast the machine is: so a flight can be repeated.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from agents.localization.carrier import Carrier
from agents.localization.pose_filter import PoseFilter
from agents.localization.registrar import Job, Registrar, RegistrarProcess
from agents.localization.registration import MAP_SD_M, MAP_SD_RAD, Registration
from agents.vehicles.vehicle import Telemetry
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.messages import LidarScan
from protocol.mission import Mission

log = logging.getLogger(__name__)

EFFECT_TICKS = 2
"""From a scan to its correction, in lockstep: the tenth of a second that a registration may take in flight."""
LOCKSTEP_PATIENCE_S = 15.0
"""Wall time to wait for a scan, or its registration, in lockstep; less than what others wait for this drone. It runs
out only when something hangs."""
LOCKSTEP_QUEUE = 8
"""Scans that may have come before their turn, in lockstep; in real time the newest alone."""


@dataclass(slots=True)
class ScanCounts:
    taken: int = 0
    """Scans that corrected the estimate ..."""
    refused: int = 0
    """... whose pose did not fit or was too far from what the velocity says, or came too late ..."""
    missed: int = 0
    """... and that were never registered: a newer one was there, or they did not come."""


class LidarOdometry:
    def __init__(
        self, mission: Mission, drone: int, bus: Bus, *, lockstep: bool, registrar: Registrar | None = None
    ) -> None:
        """``registrar``: a process of its own if none is given."""
        self._mission, self._bus, self._lockstep, self._drone = mission, bus, lockstep, drone
        self._registrar = registrar or RegistrarProcess(mission.lidar)
        expected_mps = mission.localization.velocity_error_mps
        self._carrier = Carrier(mission.tick_s, expected_mps, MAP_SD_M, MAP_SD_RAD)
        self._scans: deque[LidarScan] = deque(maxlen=LOCKSTEP_QUEUE if lockstep else 1)
        self._asked: tuple[int, Future[Registration]] | None = None
        self._kept: Floats | None = None
        self._broken = False
        self.counts = ScanCounts()
        bus.on(topics.SCAN, self._hear, drone)

    def prepare(self) -> None:
        self._registrar.start()

    def close(self) -> None:
        self._registrar.close()
        if self._carrier.filter is not None:
            log.info("drone %d: lidar: %s", self._drone, self.counts)

    def _hear(self, scan: LidarScan) -> None:
        if scan.points.dtype != np.int16 or scan.points.ndim != 2 or scan.points.shape[1:] != (3,):
            self._bus.statistics.refused[topics.SCAN.key] += 1
            return
        if self._scans and scan.tick <= self._scans[-1].tick:
            return
        self.counts.missed += len(self._scans) == self._scans.maxlen
        self._scans.append(scan)

    async def locate(self, tick: int, telemetry: Telemetry | None) -> Telemetry | None:
        """The vehicle's velocity carries the estimate to ``tick``; telemetry's age stays the vehicle's own."""
        if telemetry is None or not (np.isfinite(telemetry.pose).all() and np.isfinite(telemetry.velocity).all()):
            return telemetry  # the agent stops at that
        if self._lockstep:
            await self._wait_for_result(tick)
        self._take_result(tick)
        if self._lockstep:
            await self._wait_for_scan(tick - 1)
        self._submit(tick)
        return self._carrier.fused(telemetry, self._carry(tick, telemetry))

    async def _wait_for_result(self, tick: int) -> None:
        if self._asked is not None and self._asked[0] + EFFECT_TICKS <= tick:
            await asyncio.wait({asyncio.wrap_future(self._asked[1])}, timeout=LOCKSTEP_PATIENCE_S)

    async def _wait_for_scan(self, due: int) -> None:
        if due % self._mission.scan_ticks or self._carrier.filter is None or self._carrier.filter.at(due) is None:
            return
        if not await self._bus.until(lambda: any(scan.tick >= due for scan in self._scans), LOCKSTEP_PATIENCE_S):
            log.warning("drone %d: the scan of tick %d did not come: this run cannot be repeated", self._drone, due)
            self.counts.missed += 1

    def _carry(self, tick: int, telemetry: Telemetry) -> PoseFilter:
        start_m = max(self._mission.localization.start_deviation_m, telemetry.position_sd_m)
        return self._carrier.carry(tick, telemetry, start_m, max(MAP_SD_RAD, telemetry.angle_sd_rad))

    def _submit(self, tick: int) -> None:
        """Have the oldest scan from before ``tick`` registered, if nothing else is."""
        if self._carrier.filter is None or self._asked is not None or self._broken:
            return
        if not self._scans or self._scans[0].tick >= tick:
            return
        scan = self._scans.popleft()
        guess = self._carrier.filter.at(scan.tick)
        if guess is None:  # from before the first tick, or of one that was passed over
            self.counts.missed += 1
            return
        self._asked = scan.tick, self._registrar.submit(Job(self._kept, scan.points, guess))
        self._kept = None

    def _take_result(self, tick: int) -> None:
        if self._asked is None or not self._asked[1].done():
            return
        asked, future = self._asked
        if self._lockstep and asked + EFFECT_TICKS > tick:
            return
        self._asked = None
        located = self._carrier.filter
        error = future.exception()
        if error is not None or located is None:
            log.error("drone %d: scans are registered no longer: %s", self._drone, error)
            self._broken = True
            return
        result = future.result()
        if result.fits and located.correct(asked, result.pose, result.covariance):
            self.counts.taken += 1
            self._kept = located.at(asked)
        else:
            self.counts.refused += 1
