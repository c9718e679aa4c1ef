"""How well a map is made anew: settings under one name, each with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, TypeAlias

Quality: TypeAlias = Literal["flown", "fast", "high"]

QUALITIES: Final[Mapping[Quality, Mapping[str, Any]]] = {
    "flown": {},  # as the mission has it
    "fast": {  # as missions fly by default
        "sweep_width_px": 128,
        "depth_planes": 48,
        "sources": 4,
        "voxel_m": 0.025,
        "truncation_m": 0.05,
    },
    "high": {
        "sweep_width_px": 160,  # depth maps of 160 x 90 with as many planes as they can tell apart: F +0.015
        "depth_planes": 64,
        "sources": 5,  # one more view that may see what hides a point from the others
        "voxel_m": 0.015,  # legs and edges that 2.5 cm closes or loses: F +0.010, objects +0.013, five times the memory
        "truncation_m": 0.045,  # three voxels; 5 cm was best at 2.5 cm, and thinner things bear less
    },
}
"""Of the mission's table ``reconstruction``. What a backend does not know is of no effect on it."""


def assignments_of(quality: Quality) -> list[str]:
    """As `ground_station.replay.settings.with_settings` reads them."""
    return [f"reconstruction.{name}={_toml(value)}" for name, value in QUALITIES[quality].items()]


def _toml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value!r}"
