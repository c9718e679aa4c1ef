"""What a capture's frames say of the drones' bodies: which poses are passed on, and what people are told. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from protocol.messages import QUATERNION_TOLERANCE, ExternalPose
from protocol.mission import Mission

Seen = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position, m, and attitude w, x, y, z."""
EARLY: Final = 0.5
"""Share of a period by which a frame may come too early to count for the next pose."""
FROZEN_S: Final = 0.5
"""A body whose place is the same to the last bit for so long is not measured: some systems repeat the last pose of a
body that they have lost, and no measurement is free of noise."""
MISSING_S: Final = 1.0
"""A body that was not seen for so long is told of."""


@dataclass(slots=True)
class _Body:
    drone: int
    due_s: float = -math.inf
    seen: Seen | None = None
    """As it was last."""
    moved_s: float = -math.inf
    """When that was another than before ..."""
    seen_s: float = -math.inf
    """... and when it was believed."""
    present: bool | None = None
    """Whether people think that it is seen; None before they were told anything."""
    passed: int = 0
    """Poses since the last report."""


class Bodies:
    def __init__(self, mission: Mission, say: Callable[[str], None], began_s: float) -> None:
        """``say``: tells people."""
        self._mission, self._say = mission, say
        self._period_s = 1 / mission.mocap.rate_hz
        self._may_freeze = mission.mocap.system == "mock"
        self._bodies = {drone.rigid_body: _Body(drone.id, seen_s=began_s) for drone in mission.drones}
        self._reported_s = began_s
        self._strangers: set[str] = set()

    def frame(self, seen: Mapping[str, Seen], at_s: float, tick: int, age_s: float) -> list[ExternalPose]:
        """What is to be passed on of a frame. ``at_s``: when it came, monotonic; ``tick``: the mission's newest;
        ``age_s``: how old the frame is."""
        strangers = set(seen) - set(self._bodies) - self._strangers
        if strangers:
            self._strangers |= strangers
            self._say(f"other bodies are seen too: {', '.join(sorted(strangers))}; drones' are named by drones.body")
        poses = []
        for name, body in self._bodies.items():
            found = self._believed(body, seen.get(name), at_s)
            self._tell(name, body, at_s, seen=found is not None)
            if at_s < body.due_s - EARLY * self._period_s:
                continue
            body.due_s = max(body.due_s, at_s - self._period_s) + self._period_s
            body.passed += found is not None
            position, attitude = found or (None, None)
            poses.append(ExternalPose(drone=body.drone, tick=tick, age_s=age_s, position=position, attitude=attitude))
        return poses

    def _believed(self, body: _Body, seen: Seen | None, at_s: float) -> Seen | None:
        if seen is None or not _is_pose(seen):
            return None
        if body.seen is None or seen[0] != body.seen[0]:
            body.seen, body.moved_s = seen, at_s
        if at_s - body.moved_s > FROZEN_S and not self._may_freeze:
            return None
        return seen

    def _tell(self, name: str, body: _Body, at_s: float, *, seen: bool) -> None:
        if seen:
            body.seen_s = at_s
        missing = at_s - body.seen_s > MISSING_S
        if (seen and body.present is not True) or (missing and body.present is not False):
            body.present = seen
            self._say(f"drone {body.drone}: its body {name!r} is {'seen' if seen else 'not seen'}")

    def report(self, now_s: float) -> str:
        """Poses a second of each drone since the last report."""
        elapsed_s = max(now_s - self._reported_s, 1e-6)
        self._reported_s = now_s
        rates = [f"drone {body.drone}: {body.passed / elapsed_s:.1f}" for body in self._bodies.values()]
        for body in self._bodies.values():
            body.passed = 0
        return f"poses a second: {', '.join(rates)}"


def _is_pose(seen: Seen) -> bool:
    position, attitude = seen
    length = math.hypot(*attitude)
    return all(map(math.isfinite, position)) and abs(length - 1) <= QUATERNION_TOLERANCE
