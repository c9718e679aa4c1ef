"""Which planner decides where a drone flies, and what the baselines need: ``[planners]`` of a mission file.

The paper compares with these baselines and states none of their settings but the camera: straight down for lawnmower,
persistent and angle_aware_down. What else is here is ours, and the same for all of them where it can be.
"""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

from pydantic import Field

from protocol.settings import Metres, NonNegative, Positive, Settings

PlannerName = Literal["coverage", "lawnmower", "persistent", "angle_aware_down", "angle_aware"]

FREE_AXES: Final[dict[PlannerName, tuple[bool, bool, bool, bool, bool]]] = {
    "coverage": (True, True, True, True, True),
    "lawnmower": (False, False, False, False, False),
    "persistent": (False, False, False, False, False),
    "angle_aware_down": (True, True, False, False, False),
    "angle_aware": (True, True, False, True, True),
}
"""Along which of x, y, z, yaw, pitch the importance phi moves a drone."""
DOWNWARD: Final[frozenset[PlannerName]] = frozenset({"lawnmower", "persistent", "angle_aware_down"})
"""Those whose camera looks straight down."""
DOWN_RAD: Final = math.pi / 2
"""Depression of a camera that looks straight down."""
DOWN_TOLERANCE_RAD: Final = 0.02
"""A gimbal whose range ends so near to it looks straight down; 1.1 degrees, 4 pixels of the default camera."""


class Planners(Settings):
    """What the baseline planners need besides the paper's settings."""

    altitude_m: Metres = 2.0
    """Height z that every baseline keeps, because their drones move in a plane: where the paper's first drone starts,
    and D above the middle of B."""
    overlap: Annotated[float, Field(ge=0, le=0.9)] = 0.6
    """Lawnmower: share of a strip's width that the next one sees too. The paper does not state it; 60 to 80 % are usual
    for maps from images."""
    regrowth_per_s: NonNegative = 0.01
    """Persistent: rate at which importance returns to 1 where nobody looks. The paper does not state it; in 1/rate one
    drone sweeps the default field once."""
    persistent_rate_per_s: Positive = 0.3
    """Persistent: gamma of its own certificate, the wished mean decay of a drone's own cells. The paper does not state
    it. So much that nobody ever meets it and all fly as fast as they may, as with the paper's gamma on phi; on the
    planar field that gamma would be met by hovering."""


def planner_faults(
    planner: PlannerName,
    planners: Planners,
    heights_m: tuple[float, float],
    pitch_limits_rad: tuple[float, float],
) -> list[str]:
    """Why ``planner`` cannot fly between these heights with this gimbal; every fault opens with its key."""
    faults = []
    low, high = heights_m
    if planner != "coverage" and not low <= planners.altitude_m <= high:
        faults.append(
            f"planners.altitude_m: {planners.altitude_m:g} lies outside the flight region, {low:g} to {high:g}"
        )
    end = pitch_limits_rad[1]
    if planner in DOWNWARD and end < DOWN_RAD - DOWN_TOLERANCE_RAD:
        faults.append(
            f"controller.planner: {planner!r} looks straight down, pi/2,"
            f" but the range of the gimbal, flight.pitch_limits_rad, ends at {end:g}"
        )
    return faults
