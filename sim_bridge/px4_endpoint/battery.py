"""A battery that empties evenly while the motors turn."""

from __future__ import annotations

from dataclasses import dataclass

CELLS = 4
FULL_V, EMPTY_V = 4.05, 3.5
"""Volts of a cell, PX4's BAT1_V_CHARGED and what it takes for empty."""
HOVER_A = 12.0
IDLE_A = 0.4


@dataclass(slots=True)
class Battery:
    flight_s: float
    """Flight time of a full one."""
    share: float = 1.0

    def drain(self, dt: float) -> None:
        self.share = max(0.0, self.share - dt / self.flight_s)

    @property
    def cell_v(self) -> float:
        return EMPTY_V + (FULL_V - EMPTY_V) * self.share
