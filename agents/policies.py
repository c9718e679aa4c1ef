"""What a drone does when it cannot go on as planned: one table, the first thing asked every tick.

Every row is judged on its own; the most severe order of those that hold wins. Three things are not the maximum:
a pilot outranks everything, a return waits where there is no pose to steer by, and what was begun for good is not
taken back (`Policy.lasts`). No clock, no messages, no vehicle here: a `Situation` in, an `Order` out. docs/px4.md
shows the table, made by `policy_table`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from agents.vehicles.vehicle import Authority
from protocol.airspace import airspace_of
from protocol.mission import Flight, Mission

Action = Literal["fly", "wait", "hold", "return", "land", "yield"]
"""fly: what the planner decides. wait: nothing is sent, the vehicle does not obey yet. hold: zero velocity, keeping
distance. return: to the start, then land. land: come down here; on the ground: stay there, do not take off. yield:
nothing is sent and nothing ordered, a pilot flies."""
Wish = Literal["fly", "hold", "return", "land"]
SEVERITY: tuple[Action, ...] = ("wait", "hold", "return", "land", "yield")
"""Of what rows order; the later one wins. A drone flies when none does."""

ESTIMATE_STEADY_S = 2.0
"""An estimate that has not jumped for so long is flown by again; an EKF that is reset settles within about a second."""


@dataclass(frozen=True, slots=True)
class Situation:
    """All that the policies judge, at one moment."""

    authority: Authority
    authority_reason: str = ""
    """What the vehicle says of it (`agents.vehicles.vehicle.Condition.reason`)."""
    starting_s: float = 0.0
    """How long the authority has been "starting"; 0 if it is another."""
    battery: float = 1.0
    """Share left ..."""
    reserve: float = 0.0
    """... and that at which it just gets home (`agents.energy.Reserve.share`); 0 where nobody needs to know."""
    telemetry_age_s: float = 0.0
    outside_m: float = 0.0
    """Distance from the flight region (`outside_m`); 0 inside."""
    jump_age_s: float = math.inf
    """Since the position estimate jumped last."""
    position_sd_m: float = 0.0
    """Standard deviation of the position ..."""
    unsure_s: float = 0.0
    """... and for how long it has been larger than allowed."""
    gimbal_lost: bool = False
    ground_away_s: float = 0.0
    """Since the ground station was heard last; always 0 in lockstep, which waits instead."""
    map_age_s: float = 0.0
    """Since a map of free cells was heard last; always 0 in lockstep, and without obstacles."""
    finished: str = ""
    """Why the mission is over; empty while it is not."""
    operator: Wish = "fly"
    """What an operator ordered last."""


@dataclass(frozen=True, slots=True)
class Order:
    action: Action
    policy: str = "as planned"
    """Name of the row that decided."""
    reason: str = ""
    """For people; does not change while the row decides, so that a new reason is news."""


@dataclass(frozen=True, slots=True)
class Policy:
    """One row of the table."""

    name: str
    when: str
    """The condition in words; names in backquotes are settings of the mission."""
    judged: frozenset[Authority]
    """With whom in charge the condition is looked at; otherwise it does not hold."""
    holds: Callable[[Mission, Situation], bool]
    action: Callable[[Mission], Action]
    then: str
    """The action in words."""
    reason: Callable[[Situation], str]
    lasts: bool = False
    """Whether it goes on, once begun, though the condition is over."""
    blind: bool = False
    """Whether there is no pose to steer by while it holds: then a drone cannot return."""


_ON_ITS_WAY: frozenset[Authority] = frozenset({"ready", "starting", "ours", "lost"})
_OFF_THE_GROUND: frozenset[Authority] = frozenset({"starting", "ours", "lost"})
_OURS: frozenset[Authority] = frozenset({"ours"})


POLICIES: tuple[Policy, ...] = (
    Policy(
        "take-over",
        "the safety pilot or the autopilot itself changed the mode",
        judged=frozenset({"yielded"}),
        holds=lambda _mission, _now: True,
        action=lambda _mission: "yield",
        then="yield: nothing is sent until the vehicle is in OFFBOARD again",
        reason=lambda now: now.authority_reason or "somebody else flies",
    ),
    Policy(
        "landing",
        "the vehicle comes down as it was told, or stands on the ground after its flight",
        judged=frozenset({"landing", "landed"}),
        holds=lambda _mission, _now: True,
        action=lambda _mission: "land",
        then="land, and stay there",
        reason=lambda now: now.authority_reason or now.authority,
        lasts=True,
    ),
    Policy(
        "telemetry lost",
        "nothing heard of the vehicle for `vehicles.telemetry_lost_s`",
        judged=_OFF_THE_GROUND,
        holds=lambda mission, now: now.authority == "lost" or now.telemetry_age_s > mission.vehicles.telemetry_lost_s,
        action=lambda _mission: "land",
        then="land, should it still hear us",
        reason=lambda now: f"telemetry {now.telemetry_age_s:.1f} s old",
        lasts=True,
    ),
    Policy(
        "operator: land",
        'an operator commanded "land" or "abort"',
        judged=_ON_ITS_WAY,
        holds=lambda _mission, now: now.operator == "land",
        action=lambda _mission: "land",
        then="land here",
        reason=lambda _now: "commanded",
        lasts=True,
    ),
    Policy(
        "battery critical",
        "share left at or below `vehicles.battery_critical`",
        judged=_ON_ITS_WAY,
        holds=lambda mission, now: now.battery <= mission.vehicles.battery_critical,
        action=lambda _mission: "land",
        then="land here",
        reason=lambda now: f"battery at {now.battery:.0%}",
        lasts=True,
    ),
    Policy(
        "geofence",
        "outside the flight region by more than `vehicles.fence_margin_m`",
        judged=_OURS,
        holds=lambda mission, now: now.outside_m > mission.vehicles.fence_margin_m,
        action=lambda _mission: "land",
        then="land here",
        reason=lambda now: f"{now.outside_m:.2f} m outside the flight region",
        lasts=True,
    ),
    Policy(
        "position lost",
        "the standard deviation of the position was above `localization.deviation_max_m` for `localization.lost_s`",
        judged=_OURS,
        holds=lambda mission, now: now.unsure_s > mission.localization.lost_s,
        action=lambda _mission: "land",
        then="land here",
        reason=lambda now: f"position known to {now.position_sd_m:.2f} m",
        lasts=True,
    ),
    Policy(
        "mission end",
        "the mission is over",
        judged=_ON_ITS_WAY,
        holds=lambda _mission, now: bool(now.finished),
        action=lambda mission: mission.vehicles.at_end,
        then="return, land or hold, by `vehicles.at_end`",
        reason=lambda now: now.finished,
        lasts=True,
    ),
    Policy(
        "operator: return",
        'an operator commanded "return"',
        judged=_ON_ITS_WAY,
        holds=lambda _mission, now: now.operator == "return",
        action=lambda _mission: "return",
        then="return to the start and land",
        reason=lambda _now: "commanded",
        lasts=True,
    ),
    Policy(
        "battery low",
        "share left at or below `vehicles.battery_low`",
        judged=_ON_ITS_WAY,
        holds=lambda mission, now: now.battery <= mission.vehicles.battery_low,
        action=lambda _mission: "return",
        then="return to the start and land",
        reason=lambda now: f"battery at {now.battery:.0%}",
        lasts=True,
    ),
    Policy(
        "battery reserve",
        "share left above `vehicles.battery_critical` at or below `vehicles.reserve_factor` times what the way home and"
        " the landing take",
        judged=_OURS,
        holds=lambda _mission, now: now.battery <= now.reserve,
        action=lambda _mission: "return",
        then="return to the start and land",
        reason=lambda now: f"battery at {now.battery:.0%}, the way home is kept {now.reserve:.0%}",
        lasts=True,
    ),
    Policy(
        "gimbal lost",
        "the gimbal has not been heard or not obeyed for `vehicles.gimbal_lost_s`",
        judged=_OURS,
        holds=lambda _mission, now: now.gimbal_lost,
        action=lambda _mission: "return",
        then="return to the start and land",
        reason=lambda _now: "the gimbal does not obey",
        lasts=True,
    ),
    Policy(
        "ground station lost",
        "not heard for `replication.ground_patience_s`",
        judged=_OURS,
        holds=lambda mission, now: now.ground_away_s > mission.replication.ground_patience_s,
        action=lambda mission: mission.replication.ground_lost,
        then="hold or land, by `replication.ground_lost`, until it is back",
        reason=lambda now: f"no ground station for {now.ground_away_s:.0f} s",
    ),
    Policy(
        "obstacle map stale",
        "no map of free cells for the stale_s of `flight.obstacles`, where they are enabled",
        judged=_OURS,
        holds=lambda mission, now: now.map_age_s > mission.flight.obstacles.stale_s,
        action=lambda _mission: "hold",
        then="hold until one comes; what was seen free stays free, so a return goes on",
        reason=lambda _now: "no map of free cells",
    ),
    Policy(
        "operator: pause",
        'an operator commanded "pause"',
        judged=_ON_ITS_WAY,
        holds=lambda _mission, now: now.operator == "hold",
        action=lambda _mission: "hold",
        then='hold until "resume"; on the ground, do not take off',
        reason=lambda _now: "commanded",
    ),
    Policy(
        "telemetry stale",
        "telemetry older than `vehicles.telemetry_stale_s`",
        judged=_OURS,
        holds=lambda mission, now: now.telemetry_age_s > mission.vehicles.telemetry_stale_s,
        action=lambda _mission: "hold",
        then="hold until it is fresh; a return waits",
        reason=lambda now: f"telemetry {now.telemetry_age_s:.1f} s old",
        blind=True,
    ),
    Policy(
        "estimate jumped",
        "the position estimate moved by more than `vehicles.jump_m` beyond what the vehicle can",
        judged=_OURS,
        holds=lambda _mission, now: now.jump_age_s < ESTIMATE_STEADY_S,
        action=lambda _mission: "hold",
        then=f"hold until it has been steady for {ESTIMATE_STEADY_S:g} s; a return waits",
        reason=lambda _now: "the position estimate jumped",
        blind=True,
    ),
    Policy(
        "position unsure",
        "the standard deviation of the position is above `localization.deviation_max_m`",
        judged=_OURS,
        holds=lambda mission, now: now.position_sd_m > mission.localization.deviation_max_m,
        action=lambda _mission: "hold",
        then="hold until it is known better; a return waits",
        reason=lambda now: f"position known to {now.position_sd_m:.2f} m",
        blind=True,
    ),
    Policy(
        "not ours yet",
        "on the ground, taking off, or the autopilot refuses OFFBOARD",
        judged=frozenset({"ready", "starting"}),
        holds=lambda _mission, _now: True,
        action=lambda _mission: "wait",
        then="nothing is sent; a return waits for `vehicles.takeoff_s`, then the drone lands here",
        reason=lambda now: now.authority_reason or now.authority,
    ),
)
"""In order of precedence among equals: of two rows with the same action, the upper one is named."""


class Policies:
    """The table of one drone, with what it has begun."""

    def __init__(self, mission: Mission, table: Sequence[Policy] = POLICIES) -> None:
        self._mission, self._table = mission, table
        self._begun: dict[str, str] = {}
        """Of the rows that hold, and those that last: name to the reason at their beginning."""

    def decide(self, now: Situation) -> Order:
        if now.authority == "ready":  # it stands on the ground and never flew: nothing was begun
            self._begun.clear()
        rows = [policy for policy in self._table if self._is_active(policy, now)]
        # `max` keeps the first among equals, which is the upper row.
        decisive = max(rows, key=self._severity, default=None)
        if decisive is None:
            return Order("fly")
        action = decisive.action(self._mission)
        if action == "return":
            blind = max((policy for policy in rows if policy.blind), key=self._severity, default=None)
            if blind is not None:
                decisive, action = blind, blind.action(self._mission)
        if now.authority in ("ready", "starting") and action in ("hold", "return"):
            action = self._without_control(action, now)
        return Order(action, decisive.name, self._begun[decisive.name])

    def _is_active(self, policy: Policy, now: Situation) -> bool:
        if now.authority in policy.judged and policy.holds(self._mission, now):
            self._begun.setdefault(policy.name, policy.reason(now))
        elif not policy.lasts:
            self._begun.pop(policy.name, None)
        return policy.name in self._begun

    def _severity(self, policy: Policy) -> int:
        return SEVERITY.index(policy.action(self._mission))

    def _without_control(self, action: Action, now: Situation) -> Action:
        """What becomes of a hold or a return when the vehicle does not fly what it is sent: it may do so soon, it keeps
        its place by itself until then, and it can come down by itself."""
        if now.authority == "ready":
            return "land"
        overdue = now.starting_s > self._mission.vehicles.takeoff_s
        return "land" if action == "return" and overdue else "wait"


def outside_m(flight: Flight, position: Sequence[float]) -> float:
    """Distance of ``position`` (x, y, z, world frame) from the flight region, metres; 0 inside. Zones and the
    boundary begin where their clearance does."""
    bounds = zip(flight.lower_m, position, flight.upper_m, strict=True)
    outside = math.hypot(*(max(low - value, 0.0, value - high) for low, value, high in bounds))
    return max(outside, airspace_of(flight).inside_m(np.array(position, float)))


def policy_table() -> list[tuple[str, str, str, str]]:
    """The rows for the documents: name, condition, order, and whether it outlasts its condition."""
    return [
        (policy.name, policy.when, policy.then, "for good" if policy.lasts else "while it holds") for policy in POLICIES
    ]
