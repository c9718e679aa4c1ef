"""Scans from poses to the bus, beside the clock: measured and sent on a thread of their own."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats

if TYPE_CHECKING:
    from sim_bridge.lidar import LidarSensor


class Scanner:
    def __init__(self, bus: Bus, sensor: LidarSensor | None, scan_ticks: int) -> None:
        """``sensor`` None: nobody has a lidar. ``scan_ticks``: between two scans."""
        self._bus, self._sensor, self._scan_ticks = bus, sensor, scan_ticks
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="lidar")
        self._scanning: asyncio.Future[None] | None = None

    async def scan(self, tick: int, poses: Mapping[int, Floats], *, wait: bool) -> None:
        """Have all lidars measure that are due at ``tick``; ``poses`` (5,) by drone. ``wait``: until that is sent; else
        a round is left out while another is still at work."""
        sensor = self._sensor
        if sensor is None or tick % self._scan_ticks:
            return
        if not wait and self._scanning is not None and not self._scanning.done():
            return
        placed = {drone: pose.copy() for drone, pose in sorted(poses.items())}

        def measure() -> None:
            for drone, pose in placed.items():
                self._bus.put(topics.SCAN, sensor.scan(drone, tick, pose), drone)

        self._scanning = asyncio.get_running_loop().run_in_executor(self._worker, measure)
        if wait:
            await self._scanning

    def close(self) -> None:
        self._worker.shutdown(cancel_futures=True)
