"""Where the camera was when an image was taken: recent poses, interpolated at the image's time stamp.

Poses come at the control rate from the agent's thread, images later and at their own rate in the camera's. An image
whose moment the poses do not cover is refused: one that is posed by guess would ruin the map silently.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from protocol.geometry import Floats, camera_rotation

KEPT_S = 5.0
"""How far back poses are kept: longer than any stall of a camera's link that its frames survive."""
GAP_MAX_S = 0.25
"""Poses further apart are not interpolated between: five ticks of 20 Hz, in which a drone may brake and turn."""
BEYOND_MAX_S = 0.06
"""So much after the newest pose, or before the oldest, that pose is still used: a tick of 20 Hz and its jitter."""


@dataclass(frozen=True, slots=True)
class Moment:
    tick: int
    """The newest one that had begun."""
    pose: Floats
    """(5,), world frame."""
    rotation: Floats
    """(3, 3), camera to world."""
    deviations: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of position and angles, m and rad."""


@dataclass(frozen=True, slots=True)
class _Entry:
    stamp_s: float
    tick: int
    pose: Floats
    rotation: Floats | None
    deviations: tuple[float, float]


class PoseHistory:
    """Any thread may call any method."""

    def __init__(self) -> None:
        self._entries: list[_Entry] = []
        self._noted = threading.Condition()

    def note(
        self,
        stamp_s: float,
        tick: int,
        pose: Floats,
        rotation: Floats | None = None,
        deviations: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``pose`` (5,) was true at ``stamp_s``; ``rotation`` (3, 3) is the camera's, None: that of the pose. A stamp
        that is no later than the last one, as of telemetry that stands still, adds nothing."""
        entry = _Entry(stamp_s, tick, pose.copy(), None if rotation is None else rotation.copy(), deviations)
        with self._noted:
            if self._entries and stamp_s <= self._entries[-1].stamp_s:
                return
            self._entries.append(entry)
            del self._entries[: bisect_right(self._entries, stamp_s - KEPT_S, key=_stamp)]
            self._noted.notify_all()

    def wait_past(self, stamp_s: float, patience_s: float) -> bool:
        """Until a pose at or after ``stamp_s`` is known, at most ``patience_s`` long; whether it is."""
        with self._noted:
            return self._noted.wait_for(lambda: self._is_past(stamp_s), patience_s)

    def _is_past(self, stamp_s: float) -> bool:
        return bool(self._entries) and self._entries[-1].stamp_s >= stamp_s

    def at(self, stamp_s: float) -> Moment | None:
        """The camera at ``stamp_s``; None where no pose is near enough (`GAP_MAX_S`, `BEYOND_MAX_S`)."""
        with self._noted:
            index = bisect_right(self._entries, stamp_s, key=_stamp)
            before, after = self._entries[max(index - 1, 0) : index], self._entries[index : index + 1]
        if before and after:
            return _between(before[0], after[0], stamp_s)
        for nearest in (*before, *after):
            if abs(stamp_s - nearest.stamp_s) <= BEYOND_MAX_S:
                return Moment(nearest.tick, nearest.pose, _rotation(nearest), nearest.deviations)
        return None


def _stamp(entry: _Entry) -> float:
    return entry.stamp_s


def _between(before: _Entry, after: _Entry, stamp_s: float) -> Moment | None:
    gap_s = after.stamp_s - before.stamp_s
    if gap_s > GAP_MAX_S:
        return None
    share = (stamp_s - before.stamp_s) / gap_s
    change = after.pose - before.pose
    change[3] = math.remainder(change[3], math.tau)  # the short way round
    pose = before.pose + share * change
    pose[3] = math.remainder(pose[3], math.tau)
    deviations = max(before.deviations[0], after.deviations[0]), max(before.deviations[1], after.deviations[1])
    if before.rotation is None and after.rotation is None:
        return Moment(before.tick, pose, camera_rotation(pose[3], pose[4]), deviations)
    ends = Rotation.from_matrix(np.stack([_rotation(before), _rotation(after)]))
    return Moment(before.tick, pose, Slerp([0.0, 1.0], ends)(share).as_matrix(), deviations)


def _rotation(entry: _Entry) -> Floats:
    return camera_rotation(entry.pose[3], entry.pose[4]) if entry.rotation is None else entry.rotation
