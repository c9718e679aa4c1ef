"""Simulated motion capture: sees every drone's true pose, late, with noise, and not always."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from protocol.geometry import Floats
from protocol.messages import ExternalPose
from protocol.mission import Mission

CAPTURE_STREAM = 17
"""Keeps the draws of captures apart from others that are made from the same seed."""
S_PER_MIN = 60.0


class SimulatedCapture:
    """One that is asked at every tick; noise and drop-outs depend on the mission's seed and the drone alone."""

    def __init__(self, mission: Mission, *, in_step: bool = True) -> None:
        """``in_step``: ticks are the mission's; else those of the capture itself, which sees something at each."""
        self._noise = mission.simulation.mocap
        self._tick_s, self._period_ticks = mission.tick_s, mission.mocap_ticks
        if not in_step:
            self._tick_s, self._period_ticks = 1 / mission.mocap.rate_hz, 1
        self._late_ticks = round(mission.mocap.latency_s / self._tick_s)
        self._dice = {
            drone.id: np.random.default_rng([mission.seed, CAPTURE_STREAM, drone.id]) for drone in mission.drones
        }
        self._hidden_until = dict.fromkeys(self._dice, -1)
        self._true: deque[Mapping[int, Floats]] = deque(maxlen=self._late_ticks + 1)

    def look(self, tick: int, poses: Mapping[int, Floats]) -> list[ExternalPose]:
        """What is said at ``tick``, by drone; ``poses`` (5,) are the true ones. A body that is not seen is said too."""
        self._true.append({drone: pose.copy() for drone, pose in poses.items()})
        if tick % self._period_ticks:
            return []
        ready = len(self._true) > self._late_ticks
        return [self._see(drone, tick, self._true[0].get(drone) if ready else None) for drone in sorted(self._dice)]

    def _see(self, drone: int, tick: int, pose: Floats | None) -> ExternalPose:
        noise, dice = self._noise, self._dice[drone]
        period_s = self._period_ticks * self._tick_s
        if dice.random() < noise.dropouts_per_min / S_PER_MIN * period_s:
            self._hidden_until[drone] = tick + round(noise.dropout_s / self._tick_s)
        error = dice.standard_normal(4)
        age_s = self._late_ticks * self._tick_s
        if pose is None or tick < self._hidden_until[drone]:
            return ExternalPose(drone=drone, tick=tick, age_s=age_s)
        x, y, z = (pose[:3] + noise.noise_m * error[:3]).tolist()
        half_rad = float(pose[3] + noise.noise_rad * error[3]) / 2
        return ExternalPose(
            drone=drone,
            tick=tick,
            age_s=age_s,
            position=(x, y, z),
            attitude=(math.cos(half_rad), 0.0, 0.0, math.sin(half_rad)),
            position_sd_m=noise.noise_m,
            angle_sd_rad=noise.noise_rad,
        )
