"""What simulated vehicles take out of their batteries: ``[simulation.battery]`` of a mission file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from protocol.settings import NonNegative, Positive, Settings

if TYPE_CHECKING:
    from protocol.vehicle_settings import Vehicles

JOULES_PER_WH = 3600.0


class Battery(Settings):
    """Of each simulated vehicle (docs/energy.md). The defaults are of a camera drone of 1.2 kg."""

    capacity_wh: NonNegative = 0.0
    """What a full one holds; 0: endless, it stays full."""
    hover_w: Positive = 150.0
    """Power in the air, standing still."""
    speed_w_per_mps: NonNegative = 10.0
    """What each metre a second of level speed adds, ..."""
    climb_w_per_mps: NonNegative = 25.0
    """... and of climbing: m g over an efficiency of one half. Coming down saves nothing."""

    @property
    def is_endless(self) -> bool:
        return self.capacity_wh == 0

    @property
    def hover_s(self) -> float:
        """How long a full one carries a vehicle that stands still."""
        return self.capacity_wh * JOULES_PER_WH / self.hover_w


def battery_faults(battery: Battery, vehicles: Vehicles) -> list[str]:
    """What does not fit together."""
    if vehicles.battery_swap_s > 0 and vehicles.kind == "simulated" and battery.is_endless:
        return [
            "vehicles.battery_swap_s: a battery that never empties is never swapped; set simulation.battery.capacity_wh"
        ]
    return []
