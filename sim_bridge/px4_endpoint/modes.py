"""PX4's flight modes as HEARTBEAT and DO_SET_MODE write them (px4_custom_mode.h)."""

from __future__ import annotations

from enum import IntEnum

AUTO = 4
"""Main mode whose sub mode says which automatic flight."""

CUSTOM_MODE, AUTOMATIC, GUIDED, STABILISED, MANUAL_INPUT, ARMED = 1, 4, 8, 16, 64, 128
"""Bits of MAV_MODE_FLAG."""


def _custom(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


class Mode(IntEnum):
    """Value: HEARTBEAT.custom_mode."""

    MANUAL = _custom(1)
    ALTCTL = _custom(2)
    POSCTL = _custom(3)
    TAKEOFF = _custom(AUTO, 2)
    HOLD = _custom(AUTO, 3)
    RTL = _custom(AUTO, 5)
    LAND = _custom(AUTO, 6)
    OFFBOARD = _custom(6)
    STABILISED = _custom(7)

    @property
    def title(self) -> str:
        """As PX4's status texts call it."""
        return _TITLES.get(self, self.name.capitalize())

    @property
    def by_hand(self) -> bool:
        """Flown with sticks."""
        return self in (Mode.MANUAL, Mode.ALTCTL, Mode.POSCTL, Mode.STABILISED)


_TITLES = {Mode.POSCTL: "Position", Mode.ALTCTL: "Altitude", Mode.RTL: "Return"}

COMING_DOWN = (Mode.LAND, Mode.RTL, Mode.TAKEOFF)
"""Modes of one passage of a flight: none of them is kept after disarming."""


def mode_of(main: int, sub: int) -> Mode | None:
    """None when there is no such mode, or not here."""
    try:
        return Mode(_custom(main, sub if main == AUTO else 0))
    except ValueError:
        return None


def base_mode(mode: Mode, *, armed: bool) -> int:
    """HEARTBEAT.base_mode."""
    kind = MANUAL_INPUT if mode is Mode.MANUAL else MANUAL_INPUT | STABILISED
    if not mode.by_hand:
        kind = AUTOMATIC | STABILISED | GUIDED
    return CUSTOM_MODE | kind | (ARMED if armed else 0)
