"""A Kalman filter for x, y, z and yaw: carried forward by the vehicle's velocity, corrected by poses that come late.

The vehicle's velocity has a slow error, which the filter estimates too: so a pause of the corrections makes the
deviation grow with the time, not with its root. A correction is applied at the tick that it is about, and what was
carried forward since is carried forward again. No clock, no messages here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from protocol.geometry import Floats

STATES: Final = 7
"""x, y, z, yaw, and the error of the velocity along x, y, z."""
SEEN: Final = 4
"""Of them, those that a correction measures."""
VELOCITY_WHITE_MPS: Final = 0.02
"""Error of one sample of the vehicle's velocity, beside the slow one: that of optical flow at a metre."""
VELOCITY_ERROR_S: Final = 20.0
"""How long its slow error stays alike."""
YAW_WALK: Final = 0.004
"""Of the yaw, rad/sqrt(s): a gyroscope's, and what vibration adds."""
GATE: Final = 18.47
"""Squared Mahalanobis distance that a good correction exceeds once in a thousand times: chi-squared, four degrees."""
KEPT_TICKS: Final = 40
"""How far back a correction may lie: two seconds of 20 Hz, many times what a registration takes."""


@dataclass(slots=True)
class _Moment:
    tick: int
    mean: Floats
    covariance: Floats
    velocity: Floats
    """(4,) x, y, z and yaw rate with which it was carried here, ..."""
    elapsed_s: float
    """... for so long."""


class PoseFilter:
    def __init__(
        self, tick: int, pose: Floats, deviation_m: float, deviation_rad: float, velocity_sd_mps: float
    ) -> None:
        """``pose`` (4,) x, y, z, yaw at ``tick`` with its standard deviations; ``velocity_sd_mps``: of the slow error
        of the vehicle's velocity, each axis."""
        self._velocity_sd = velocity_sd_mps
        variances = [deviation_m**2] * 3 + [deviation_rad**2] + [velocity_sd_mps**2] * 3
        mean = np.concatenate([pose, np.zeros(3)])
        self._moments = [_Moment(tick, mean, np.diag(np.array(variances)), np.zeros(4), 0.0)]

    @property
    def tick(self) -> int:
        return self._moments[-1].tick

    @property
    def pose(self) -> Floats:
        """(4,) x, y, z, yaw at `tick`."""
        return self._moments[-1].mean[:SEEN].copy()

    @property
    def velocity_error(self) -> Floats:
        """(3,) what is to be taken off the vehicle's velocity."""
        return self._moments[-1].mean[SEEN:].copy()

    @property
    def covariance(self) -> Floats:
        """(4, 4) of `pose`."""
        return self._moments[-1].covariance[:SEEN, :SEEN].copy()

    def at(self, tick: int) -> Floats | None:
        """(4,) the pose at an earlier tick; None where that is forgotten or was passed over."""
        found = self._find(tick)
        return None if found is None else self._moments[found].mean[:SEEN].copy()

    def advance(self, tick: int, velocity: Floats, elapsed_s: float) -> None:
        """Carry forward to ``tick``, ``elapsed_s`` after the last, with the mean ``velocity`` (4,) since; an older tick
        changes nothing."""
        if tick <= self.tick:
            return
        self._moments.append(self._carried(self._moments[-1], tick, velocity, elapsed_s))
        del self._moments[:-KEPT_TICKS]

    @property
    def step(self) -> tuple[Floats, float]:
        """The velocity (4,) with which it was carried last, and for how many seconds."""
        return self._moments[-1].velocity, self._moments[-1].elapsed_s

    def anew(self, tick: int, pose: Floats, deviation_m: float, deviation_rad: float) -> PoseFilter | None:
        """Another one that began at an earlier ``tick`` with ``pose`` (4,), carried by the same velocities since; None
        where that is forgotten or was passed over."""
        found = self._find(tick)
        if found is None:
            return None
        fresh = PoseFilter(tick, pose, deviation_m, deviation_rad, self._velocity_sd)
        for later in self._moments[found + 1 :]:
            fresh.advance(later.tick, later.velocity, later.elapsed_s)
        return fresh

    def correct(self, tick: int, pose: Floats, covariance: Floats) -> bool:
        """Take in ``pose`` (4,) with ``covariance`` (4, 4), true at ``tick``; whether it was near enough to be
        believed, and not too late."""
        found = self._find(tick)
        if found is None:
            return False
        moment = self._moments[found]
        innovation = pose - moment.mean[:SEEN]
        innovation[3] = math.remainder(innovation[3], math.tau)
        seen = moment.covariance[:SEEN, :SEEN] + covariance
        if not np.isfinite(innovation).all() or innovation @ np.linalg.solve(seen, innovation) > GATE:
            return False
        gain = np.linalg.solve(seen, moment.covariance[:SEEN]).T
        moment.mean = moment.mean + gain @ innovation
        # Joseph's form, which stays positive whatever is rounded.
        left = np.eye(STATES)
        left[:, :SEEN] -= gain
        moment.covariance = left @ moment.covariance @ left.T + gain @ covariance @ gain.T
        for later in range(found + 1, len(self._moments)):
            old = self._moments[later]
            self._moments[later] = self._carried(self._moments[later - 1], old.tick, old.velocity, old.elapsed_s)
        return True

    def _find(self, tick: int) -> int | None:
        return next((k for k, moment in enumerate(self._moments) if moment.tick == tick), None)

    def _carried(self, before: _Moment, tick: int, velocity: Floats, elapsed_s: float) -> _Moment:
        """dp = (v - e) dt, dyaw = r dt, and e, the error, forgets itself within `VELOCITY_ERROR_S`."""
        kept = math.exp(-elapsed_s / VELOCITY_ERROR_S)
        step = np.eye(STATES)
        step[:3, SEEN:] = -elapsed_s * np.eye(3)
        step[SEEN:, SEEN:] = kept * np.eye(3)
        mean = step @ before.mean
        mean[:SEEN] += elapsed_s * velocity
        mean[3] = math.remainder(mean[3], math.tau)
        noise = np.zeros(STATES)
        noise[:3] = (VELOCITY_WHITE_MPS * elapsed_s) ** 2
        noise[3] = YAW_WALK**2 * elapsed_s
        noise[SEEN:] = self._velocity_sd**2 * (1 - kept * kept)
        return _Moment(tick, mean, step @ before.covariance @ step.T + np.diag(noise), velocity, elapsed_s)


def largest_deviation(covariance: Floats) -> float:
    """Standard deviation along the direction in which it is largest; ``covariance`` (n, n)."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance)[-1])))
