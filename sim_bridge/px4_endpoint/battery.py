"""A battery that empties evenly while the motors turn, and the crew that changes it on the ground."""

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
    swap_s: float = 0.0
    """Time on the ground after a flight until the crew has a full one; 0: nobody changes it."""
    spares: int | None = None
    """How many are left; None: as many as it takes."""
    share: float = 1.0
    _stood_s: float | None = None
    """Since it flew; None before it has."""

    def drain(self, dt: float) -> None:
        self.share, self._stood_s = max(0.0, self.share - dt / self.flight_s), 0.0

    def stand(self, dt: float) -> bool:
        """Disarmed on the ground; whether the crew changes it now: it is full then."""
        if self._stood_s is None:
            return False
        before, self._stood_s = self._stood_s, self._stood_s + dt
        if not before < self.swap_s <= self._stood_s or self.spares == 0:
            return False
        self.share, self.spares = 1.0, None if self.spares is None else self.spares - 1
        return True

    @property
    def cell_v(self) -> float:
        return EMPTY_V + (FULL_V - EMPTY_V) * self.share
