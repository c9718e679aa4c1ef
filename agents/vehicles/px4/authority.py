"""Who flies, and what the vehicle has to be told next: pure logic, with time and telemetry handed in.

PX4 acknowledges a mode that it then refuses, and tells its mode once a second. So nothing is believed but a mode that
was told after the last command had been answered, and a command whose effect does not show is given again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from agents.silence import WitnessedSilence
from agents.vehicles.vehicle import Authority

Step = Literal["wait", "arm", "disarm", "take_off", "offboard", "hold", "land"]
"""What to command now."""
Phase = Literal["ready", "climbing", "entering", "ours", "held", "yielded", "landing", "landed"]
"""climbing: armed and taken off by PX4; entering: in the air, on the way into OFFBOARD; held: put into HOLD by us,
until the control task sends again. The others as `Authority` has them."""

RETRY_S = 2.0
"""After a command was answered, its effect gets so long to show: heartbeats come once a second."""
GAP_S = 0.9
"""Silence of ours that may have made the vehicle take the link for lost; COM_OF_LOSS_T is a second."""
GAP_MEMORY_S = 5.0
"""How long ago that may be when a mode change shows: the failsafe's own delays, a heartbeat, a blocked machine."""
STREAM_S = 0.5
"""How long setpoints must have been streaming before OFFBOARD is asked for."""
CLIMB_SHORT_M = 0.5
"""A take-off that ended so far below its height was one, though none was told: it took less than a heartbeat."""
DISARM_S = 6.0
"""An autopilot that stands on the ground disarms by itself (COM_DISARM_LAND, 2 s); after so long it is told to."""

FAILSAFES = {3: "RETURN_TO_LAUNCH", 4: "LAND", 5: "HOLD"}
"""Mode that COM_OBL_RC_ACT makes of a lost link. The others look like a pilot's and are taken for one."""
CAUTIOUS = ("HOLD", "TAKEOFF", "OFFBOARD", "READY", "UNKNOWN")
"""Modes in which nobody holds the sticks and nothing is under way that must be left alone."""
STICKS = ("MANUAL", "ALTCTL", "POSCTL", "ACRO", "STABILIZED", "RATTITUDE")
PHASE_AUTHORITY: dict[Phase, Authority] = {
    "ready": "ready",
    "climbing": "starting",
    "entering": "starting",
    "ours": "ours",
    "held": "ours",
    "yielded": "yielded",
    "landing": "landing",
    "landed": "landed",
}


@dataclass(frozen=True, slots=True)
class Observation:
    """What telemetry says."""

    mode: str
    mode_at_s: float
    """When that was told."""
    armed: bool
    on_ground: bool
    height_m: float
    """World z."""
    heard_s: float
    """When anything was heard last."""
    connected: bool = True
    """MAVSDK's own judgement, by heartbeats alone."""


class AuthorityLogic:
    """Not thread-safe: its owner serialises the calls. ``now_s`` never goes backwards."""

    def __init__(self, start_m: float, lost_after_s: float, failsafe: str = "HOLD") -> None:
        """``start_m``: world z to climb to; ``lost_after_s``: silence after which the vehicle counts as lost;
        ``failsafe``: the mode it falls into when setpoints stay away, one of `FAILSAFES`, or "" if a pilot's."""
        self._start_m, self._lost_after_s, self._failsafe = start_m, lost_after_s, failsafe
        self.phase: Phase = "ready"
        self._reason = ""
        self._refusal = ""
        self.unheeded = ""
        """What the vehicle acknowledged last without doing it, for people; stays until it is something else."""
        self._seen: Observation | None = None
        self._silence = WitnessedSilence()
        self._was_silent = False
        self.silences = 0
        """How often it fell silent on the ground after a flight: its power may have been off."""
        self._land_ordered = False
        self._landing_seen = False
        self._climb_seen = False
        """Whether the mode has been TAKEOFF: before, another one is only old news."""
        self._flew = False
        self._entered_s = -math.inf
        self._answered_s = -math.inf
        """A mode told later than that is believed; infinite while a command is on its way."""
        self._tried: tuple[Step, float] = ("wait", -math.inf)
        self._sent_s: float | None = None
        self._gap: tuple[float, float] = (0.0, -math.inf)
        """Length and end of the last gap."""

    # Orders of the owner

    def take_off(self, now_s: float) -> None:
        """Only from ``ready``."""
        seen = self._seen
        if self.phase != "ready" or seen is None:
            return
        if seen.on_ground:
            self._enter("climbing", now_s, "taking off")
        elif seen.mode in CAUTIOUS or seen.mode == self._failsafe:
            self._enter("entering", now_s, "taking over in the air")
        else:
            self._enter("yielded", now_s, f"in the air in {seen.mode}")

    def sent(self, now_s: float) -> bool:
        """The control task sends; whether that may fly."""
        if self._sent_s is not None and now_s - self._sent_s > GAP_S:
            self._gap = (now_s - self._sent_s, now_s)
        self._sent_s = now_s
        if self.phase == "held":
            self._enter("entering", now_s, "the control task is back")
        return self.authority == "ours"

    def hold(self, *, direct: bool) -> bool:
        """Whether the vehicle is to be told. A pilot's vehicle and one that lands or stands are left alone.

        ``direct``: the caller commands it and calls `answered`; otherwise `observe` will ask for it.
        """
        seen = self._seen
        if self.phase not in ("climbing", "entering", "ours", "held") or seen is None or seen.on_ground:
            return False
        if self.phase == "held" and (self._is_busy or (seen.mode == "HOLD" and self._is_news(seen))):
            return False
        self.phase, self._reason, self._refusal = "held", "holds until the control task sends again", ""
        self._tried = ("wait", -math.inf)
        if direct:
            self._answered_s = math.inf
        return True

    def land(self, *, direct: bool) -> bool:
        """Likewise. A pilot's vehicle lands when it is given back."""
        self._land_ordered = True
        if self.phase in ("yielded", "landed") or (self.phase == "landing" and self._is_busy):
            return False
        if self.phase != "landing":
            self._begin_landing()
        if self._seen is None or self._seen.on_ground:
            return False
        if direct:
            self._answered_s = math.inf
        return True

    def _begin_landing(self) -> None:
        self.phase, self._reason, self._refusal, self._landing_seen = "landing", "told to land", "", False
        self._tried = ("wait", -math.inf)

    def make_ready(self, now_s: float) -> bool:
        """Whether it is: it has landed, and is disarmed."""
        seen = self._seen
        if self.phase != "landed" or seen is None or not seen.on_ground or seen.armed:
            return False
        self._enter("ready", now_s, "")
        self._land_ordered = self._landing_seen = self._climb_seen = self._flew = False
        return True

    def answered(self, step: Step, now_s: float, refusal: str = "") -> None:
        """A command came back; ``refusal``: what the vehicle said, or that it said nothing."""
        again = step == self._tried[0]
        self._answered_s, self._tried = now_s, (step, now_s)
        self._refusal = refusal or (self._refusal if again else "")

    # Telemetry

    def observe(self, seen: Observation, now_s: float) -> Step:
        """Takes in what telemetry says; what is to be commanded now. The caller reports back by `answered`."""
        before, self._seen = self._seen, seen
        if self._silence.look(seen.heard_s, now_s) > GAP_S:
            self._gap = (self._silence.silent_s, now_s)
        was_silent, self._was_silent = self._was_silent, self._is_silent(seen)
        self.silences += self.phase == "landed" and self._was_silent and not was_silent
        if self._was_silent:
            return self._due("land", now_s) if self.phase == "landing" else "wait"
        self._flew = self._flew or not seen.on_ground
        if self._flew and seen.on_ground and not seen.armed and self.phase not in ("ready", "landed"):
            self._enter("landed", now_s, self._reason if self._land_ordered else f"came down in {seen.mode}")
        changed = before is not None and before.mode != seen.mode
        by_phase = {
            "climbing": self._climb,
            "entering": self._enter_offboard,
            "ours": self._watch,
            "held": self._keep_holding,
            "yielded": self._wait_for_pilot,
            "landing": self._come_down,
        }
        follow = by_phase.get(self.phase)
        return "wait" if follow is None else follow(seen, changed, now_s)

    def _climb(self, seen: Observation, changed: bool, now_s: float) -> Step:
        if changed and seen.mode not in CAUTIOUS:
            return self._yield_to(seen, now_s)
        self._climb_seen = self._climb_seen or seen.mode == "TAKEOFF"
        has_climbed = self._climb_seen or seen.height_m > self._start_m - CLIMB_SHORT_M
        if not seen.on_ground and seen.mode != "TAKEOFF" and has_climbed:
            self._enter("entering", now_s, "took off")
            return "wait"
        if not seen.armed:
            self._reason = "arming"
            return self._due("arm" if seen.mode in ("HOLD", "TAKEOFF") else "hold", now_s)
        self._reason = f"taking off: at {seen.height_m:.1f} of {self._start_m:.1f} m"
        return "wait" if seen.mode == "TAKEOFF" else self._due("take_off", now_s)

    def _enter_offboard(self, seen: Observation, changed: bool, now_s: float) -> Step:
        if seen.mode == "OFFBOARD" and self._is_news(seen):
            self._enter("ours", now_s, "")
            return "wait"
        if changed and seen.mode not in CAUTIOUS and seen.mode != self._failsafe:
            return self._yield_to(seen, now_s)
        return self._due("offboard", now_s) if now_s - self._entered_s >= STREAM_S else "wait"

    def _watch(self, seen: Observation, _changed: bool, now_s: float) -> Step:
        if seen.mode == "OFFBOARD":
            return "wait"
        if self._sent_s is not None and now_s - self._sent_s > GAP_S:
            self._gap = (now_s - self._sent_s, now_s)
        length_s, ended_s = self._gap
        if seen.mode == self._failsafe and now_s - ended_s <= GAP_MEMORY_S:
            self._enter("entering", now_s, f"going on after a gap of {length_s:.1f} s in our setpoints")
            return "wait"
        return self._yield_to(seen, now_s)

    def _keep_holding(self, seen: Observation, changed: bool, now_s: float) -> Step:
        if changed and seen.mode not in CAUTIOUS:
            return self._yield_to(seen, now_s)
        return "wait" if seen.mode == "HOLD" or not self._is_news(seen) else self._due("hold", now_s)

    def _wait_for_pilot(self, seen: Observation, _changed: bool, now_s: float) -> Step:
        if seen.mode != "OFFBOARD":
            return "wait"
        if self._land_ordered:
            self._begin_landing()
            return self._due("land", now_s)
        self._enter("ours", now_s, "")
        return "wait"

    def _come_down(self, seen: Observation, changed: bool, now_s: float) -> Step:
        if seen.on_ground and not seen.armed:
            self._enter("landed", now_s, self._reason)
            return "wait"
        if seen.on_ground:
            if not self._flew or now_s - self._entered_s > DISARM_S:
                return self._due("disarm", now_s)
        else:
            self._entered_s = now_s
        if seen.mode == "LAND":
            self._landing_seen = self._landing_seen or self._is_news(seen)
            return "wait"
        if changed and seen.armed and (self._landing_seen or seen.mode in STICKS):
            return self._yield_to(seen, now_s)
        return "wait" if seen.on_ground else self._due("land", now_s)

    def _yield_to(self, seen: Observation, now_s: float) -> Step:
        who = "a pilot" if seen.mode in STICKS else "a pilot, a ground station or the autopilot itself"
        self._enter("yielded", now_s, f"{who} switched to {seen.mode}")
        return "wait"

    def _enter(self, phase: Phase, now_s: float, reason: str) -> None:
        self.phase, self._reason, self._refusal, self._entered_s = phase, reason, "", now_s
        self._tried = ("wait", -math.inf)
        if phase == "ours":
            self._sent_s, self._gap = now_s, (0.0, -math.inf)

    def _due(self, step: Step, now_s: float) -> Step:
        last, at_s = self._tried
        if self._is_busy or (step == last and now_s - at_s < RETRY_S):
            return "wait"
        if step == last and not self._refusal and self._seen is not None:
            self._refusal = f"{step.replace('_', ' ')} was acknowledged, but the vehicle stays in {self._seen.mode}"
            self.unheeded = self._refusal
        self._answered_s = math.inf
        return step

    def _is_news(self, seen: Observation) -> bool:
        return seen.mode_at_s > self._answered_s

    def _is_silent(self, seen: Observation) -> bool:
        """One that MAVSDK calls disconnected may only have missed heartbeats while this process stood still."""
        silent_s = self._silence.silent_s
        return silent_s > self._lost_after_s or (silent_s > GAP_S and not seen.connected)

    @property
    def _is_busy(self) -> bool:
        return self._answered_s == math.inf

    # What others see

    @property
    def authority(self) -> Authority:
        if self.phase != "landed" and self._seen is not None and self._is_silent(self._seen):
            return "lost"
        return PHASE_AUTHORITY[self.phase]

    @property
    def reason(self) -> str:
        if self.authority == "lost":
            return f"nothing heard for {self._silence.silent_s:.1f} s"
        return f"{self._reason}: {self._refusal}" if self._refusal else self._reason

    @property
    def streams(self) -> bool:
        """Whether zero velocity is streamed for the control task: PX4 enters OFFBOARD only where setpoints arrive, at
        our command as well as at a pilot's who gives the vehicle back."""
        return self.phase in ("climbing", "entering", "held", "yielded")
