"""What the policies are asked and what they said: telemetry and silence become a situation, new orders are told."""

from __future__ import annotations

import math
from collections.abc import Callable

from agents.policies import Order, Policies, Situation, Wish, outside_m
from agents.silence import WitnessedSilence
from agents.vehicles.vehicle import Condition, Telemetry
from protocol.messages import EventLevel
from protocol.mission import Mission
from protocol.news import Tell


class Orders:
    """Of one drone; asked every tick."""

    def __init__(self, mission: Mission, now_s: Callable[[], float], tell: Tell) -> None:
        """``now_s``: the clock of the telemetry's stamps. ``tell``: who wants to know of new orders."""
        self._flight, self._now_s, self._tell = mission.flight, now_s, tell
        self._policies = Policies(mission)
        self._telemetry_silence, self._ground_silence = WitnessedSilence(), WitnessedSilence()
        self._map_silence = WitnessedSilence()
        self._starting_since_s = math.inf
        self._jumps, self._jumped_at_s = 0, -math.inf
        self._deviation_max_m = mission.localization.deviation_max_m
        self._sure_at_s = math.inf
        self.newest = Order("fly")

    @property
    def stays_up(self) -> bool:
        """Whether the mission is over and the drone is to be left in the air."""
        return self.newest.action == "hold" and self.newest.policy == "mission end"

    def give(
        self,
        telemetry: Telemetry | None,
        condition: Condition,
        ground_silent_s: tuple[float, float] | None,
        finished: str,
        operator: Wish,
        reserve: float = 0.0,
        map_silent_s: tuple[float, float] | None = None,
    ) -> Order:
        """``ground_silent_s``: when the ground station was heard last, and now; None where its silence does not matter.
        ``finished``: why the mission is over; empty while it is not. ``operator``: what one ordered last. ``reserve``:
        share of the battery that the way home takes. ``map_silent_s``: like the ground station's, of its maps of free
        cells; None where there are none."""
        now_s = self._now_s()
        if condition.authority != "starting":
            self._starting_since_s = now_s
        if condition.jumps > self._jumps:
            self._jumps, self._jumped_at_s = condition.jumps, now_s
        deviation_m = 0.0 if telemetry is None else telemetry.position_sd_m
        if not deviation_m > self._deviation_max_m or self._sure_at_s > now_s:
            self._sure_at_s = now_s
        situation = Situation(
            authority=condition.authority,
            authority_reason=condition.reason,
            starting_s=now_s - self._starting_since_s,
            battery=1.0 if telemetry is None else telemetry.battery,
            reserve=reserve,
            telemetry_age_s=math.inf if telemetry is None else self._telemetry_silence.look(telemetry.stamp_s, now_s),
            outside_m=0.0 if telemetry is None else outside_m(self._flight, telemetry.pose[:3].tolist()),
            jump_age_s=now_s - self._jumped_at_s,
            position_sd_m=deviation_m,
            unsure_s=now_s - self._sure_at_s,
            gimbal_lost=condition.gimbal_lost,
            ground_away_s=0.0 if ground_silent_s is None else self._ground_silence.look(*ground_silent_s),
            map_age_s=0.0 if map_silent_s is None else self._map_silence.look(*map_silent_s),
            finished=finished,
            operator=operator,
        )
        order = self._policies.decide(situation)
        if order != self.newest:
            level: EventLevel = "info" if order.action in ("fly", "wait") else "warning"
            self._tell(level, "order", f"{order.action}: {order.policy}{f' ({order.reason})' if order.reason else ''}")
        self.newest = order
        return order
