"""The battery of a simulated vehicle, and the crew that changes it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocol.battery_settings import JOULES_PER_WH, Battery
from protocol.geometry import Floats


def power_w(settings: Battery, velocity: Floats) -> float:
    """Of a vehicle in the air that moves at ``velocity`` (5,)."""
    level, climb = math.hypot(velocity[0], velocity[1]), max(float(velocity[2]), 0.0)
    return settings.hover_w + settings.speed_w_per_mps * level + settings.climb_w_per_mps * climb


@dataclass(slots=True)
class VehicleBattery:
    """Of one vehicle."""

    settings: Battery
    swap_s: float = 0.0
    """Time on the ground after which a full one is in; 0: nobody changes it."""
    spares: int | None = None
    """How many are left; None: as many as it takes."""
    share: float = 1.0
    """What is left, 0 to 1."""
    _stood_s: float = 0.0

    def step(self, dt: float, velocity: Floats, *, down: bool) -> None:
        """``down``: it stands on the ground, its motors off."""
        if self.settings.is_endless:
            return
        if not down:
            self._stood_s = 0.0
            taken = power_w(self.settings, velocity) * dt / (self.settings.capacity_wh * JOULES_PER_WH)
            self.share = max(0.0, self.share - taken)
            return
        before, self._stood_s = self._stood_s, self._stood_s + dt
        if before < self.swap_s <= self._stood_s and self.spares != 0:
            self.share = 1.0
            self.spares = None if self.spares is None else self.spares - 1
