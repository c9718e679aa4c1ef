"""The colours by which people tell drones apart: the same in the report and in the console."""

from __future__ import annotations

from typing import Final

DRONE_COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6f4e9c", "#7a7a7a")
"""Okabe and Ito's set without yellow and black, two more added: told apart by colour-blind readers and in print."""


def drone_colour(index: int) -> str:
    """``#rrggbb`` of the drone that is number ``index`` in the mission, from 0."""
    return DRONE_COLOURS[index % len(DRONE_COLOURS)]
