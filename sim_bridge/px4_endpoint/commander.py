"""Armed or not, and in which mode: PX4's commander as far as a mission meets it. Pure: time and facts come in.

The *intended* mode is what was last commanded; a failsafe flies another one without forgetting it, so that a vehicle
whose setpoints come back goes on in OFFBOARD by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sim_bridge.px4_endpoint.dialect import mavlink
from sim_bridge.px4_endpoint.modes import COMING_DOWN, Mode
from sim_bridge.px4_endpoint.parameters import Parameters

CRITICAL: int = mavlink.MAV_SEVERITY_CRITICAL
WARNING: int = mavlink.MAV_SEVERITY_WARNING
INFO: int = mavlink.MAV_SEVERITY_INFO

OFFBOARD_LOSS = {3: Mode.RTL, 4: Mode.LAND, 5: Mode.HOLD}
"""COM_OBL_RC_ACT; the others (0 position, 1 altitude, 2 manual) need sticks and become POSCTL."""
FENCE = {2: Mode.HOLD, 3: Mode.RTL, 5: Mode.LAND}
"""GF_ACTION; 0 and 1 (warning) leave the mode alone."""
LOW_BATTERY = {2: Mode.LAND, 3: Mode.RTL}
"""COM_LOW_BAT_ACT at the critical level."""

Warned = Literal["", "low", "critical"]


@dataclass(frozen=True, slots=True)
class Situation:
    """What the commander judges by, at one moment."""

    now_s: float
    stream: bool
    """Offboard setpoints arrive, the last within COM_OF_LOSS_T."""
    landed: bool
    faults: tuple[str, ...] = ()
    """Red checks."""
    battery: float = 1.0
    outside_fence: bool = False
    took_off: bool = False
    """The take-off's altitude is reached."""


class Commander:
    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.armed = False
        self.armed_s = 0.0
        self.intended = Mode.HOLD
        self.failsafe: Mode | None = None
        self.refuse_offboard = False
        self.deny_arming = False
        self.texts: list[tuple[int, str]] = []
        """Severity and text, to be sent and cleared by the owner."""
        self._after_disarming = Mode.HOLD
        self._landed_since_s: float | None = None
        self._flew = False
        self._latched: Mode | None = None
        """A failsafe that stays until another mode is commanded."""
        self._fence_breached = False
        self._warned: Warned = ""

    @property
    def mode(self) -> Mode:
        return self.failsafe or self.intended

    def command(self, mode: Mode, situation: Situation) -> bool:
        """Intend ``mode``. A mode that cannot be flown now is refused, in flight; on the ground it is taken."""
        blocked = mode is Mode.OFFBOARD and (self.refuse_offboard or (self.armed and not situation.stream))
        if blocked:
            self.texts.append((CRITICAL, f"Switching to {mode.title} is currently not available"))
            return False
        self.intended = mode
        self.failsafe = self._latched = None
        if mode not in COMING_DOWN:
            self._after_disarming = mode
        return True

    def arm(self, situation: Situation) -> bool:
        if self.armed:
            return True
        no_stream = self.intended is Mode.OFFBOARD and not situation.stream
        if situation.faults or self.deny_arming or no_stream:
            self.texts.append((CRITICAL, "Arming denied: Resolve system health failures first"))
            self.texts += [(CRITICAL, f"Preflight Fail: {fault}") for fault in situation.faults]
            return False
        if self.intended in (Mode.LAND, Mode.RTL):
            self.texts.append((CRITICAL, f"Arming denied: switch out of {self.intended.title} mode first"))
            return False
        self.armed, self.armed_s, self._flew = True, situation.now_s, False
        self._landed_since_s = None
        self.texts.append((INFO, "Armed by external command"))
        return True

    def disarm(self, situation: Situation, *, forced: bool = False) -> bool:
        if not self.armed:
            return True
        if not situation.landed and not forced:
            self.texts.append((CRITICAL, "Disarming denied: not landed"))
            return False
        self._stand_down("Disarmed by external command")
        return True

    def step(self, situation: Situation) -> None:
        """Failsafes, end of take-off, disarming after a landing."""
        if not self.armed:
            return
        self._flew = self._flew or not situation.landed
        if situation.took_off and self.mode is Mode.TAKEOFF:
            self.intended = self._after_disarming = Mode.HOLD
        self._watch_fence(situation)
        self._watch_battery(situation)
        self._watch_stream(situation)
        self._watch_landing(situation)

    def _watch_stream(self, situation: Situation) -> None:
        lost = self.intended is Mode.OFFBOARD and not situation.stream
        was = self.failsafe
        if self._latched is not None:
            self.failsafe = self._latched
        elif lost:
            self.failsafe = OFFBOARD_LOSS.get(int(self._parameters["COM_OBL_RC_ACT"]), Mode.POSCTL)
        else:
            self.failsafe = None
        if self.failsafe is not None and self.failsafe is not was:
            self.texts.append((CRITICAL, "Failsafe activated"))

    def _watch_fence(self, situation: Situation) -> None:
        entered = situation.outside_fence and not self._fence_breached
        self._fence_breached = situation.outside_fence
        action = int(self._parameters["GF_ACTION"])
        if entered and action:
            self.texts.append((WARNING, "Geofence violation: too far from home"))
            self._latch(FENCE.get(action))

    def _watch_battery(self, situation: Situation) -> None:
        if situation.battery < self._parameters["BAT_CRIT_THR"] and self._warned != "critical":
            self._warned = "critical"
            self.texts.append((CRITICAL, "Critical battery level, land now"))
            self._latch(LOW_BATTERY.get(int(self._parameters["COM_LOW_BAT_ACT"])))
        elif situation.battery < self._parameters["BAT_LOW_THR"] and not self._warned:
            self._warned = "low"
            self.texts.append((WARNING, "Low battery level, return advised"))

    def _watch_landing(self, situation: Situation) -> None:
        if not situation.landed:
            self._landed_since_s = None
            return
        if self._landed_since_s is None:
            self._landed_since_s = situation.now_s
        patience = self._parameters["COM_DISARM_LAND" if self._flew else "COM_DISARM_PRFLT"]
        if patience > 0 and situation.now_s - self._landed_since_s > patience:
            self._stand_down("Disarmed by landing" if self._flew else "Disarmed by auto preflight disarming")

    def _latch(self, mode: Mode | None) -> None:
        """Not over a landing: that ends sooner."""
        if mode is not None and self.mode is not Mode.LAND:
            self._latched = mode

    def _stand_down(self, text: str) -> None:
        self.armed = False
        self.failsafe = self._latched = None
        self.intended = self._after_disarming
        self.texts.append((INFO, text))
