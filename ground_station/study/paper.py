"""What the paper reports, beside which our own figures stand."""

from __future__ import annotations

from typing import Final

from ground_station.study.plan_file import Method

F_SCORE: Final[dict[tuple[Method, int], float]] = {
    ("lawnmower", 1): 0.324,
    ("persistent", 1): 0.191,
    ("angle_aware_down", 1): 0.348,
    ("angle_aware", 1): 0.351,
    ("none", 1): 0.354,
    ("grid", 1): 0.438,
    ("m3c2", 1): 0.442,
    ("grid", 2): 0.422,
    ("grid", 4): 0.423,
}
"""At 5 cm after up to 1500 s, by method and drones, with J_th = `THRESHOLD`."""
QUARTER_S: Final[dict[tuple[Method, int], float]] = {("grid", 1): 850.0, ("grid", 2): 620.0, ("grid", 4): 320.0}
"""Mission time to J = 0.25, likewise."""
UPDATE_S: Final[dict[Method, float]] = {"grid": 0.2131, "m3c2": 1.8585}
"""Mean time of one feedback update, on 24 cores of up to 6 GHz and a graphics card."""
THRESHOLD: Final = 0.5

NAMES: Final[dict[Method, str]] = {
    "lawnmower": "lawnmower, camera down (Torres 2016)",
    "persistent": "persistent coverage, camera down (Dan 2020)",
    "angle_aware_down": "angle-aware, camera down (Shimizu 2021)",
    "angle_aware": "angle-aware, rotating camera (Lu 2024)",
    "none": "this controller, no feedback",
    "grid": "this controller, grid feedback",
    "m3c2": "this controller, M3C2 feedback",
}
"""In the paper's order."""


def label(method: Method, drones: int, threshold: float) -> str:
    """Of a series, without its scene."""
    parts = [NAMES[method]]
    if drones > 1:
        parts.append(f"{drones} drones")
    if threshold != THRESHOLD:
        parts.append(f"J_th {100 * threshold:.0f} %")
    return ", ".join(parts)
