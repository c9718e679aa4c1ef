"""When a frame of a live camera came, though it lay in a queue before it was read.

A stream that is opened hands out a second of frames at once, and a link that stalls hands out late what it held back:
posed by the time of reading, such images would lie where the drone is by then. The camera's own time stamps tell how
long after each other frames were taken; the quickest frame tells how the camera's clock reads against ours.
"""

from __future__ import annotations

import math

SETTLED_S = 0.5
"""A quickest frame that none has beaten for so long is believed; a queue that drains brings a quicker one each time."""
BEATEN_S = 0.01
"""By how much a quicker frame must be quicker to count: jitter of a good link, and 5 mm at 0.5 m/s."""
FORGETTING = 0.002
"""The quickest frame's delay grows by so much a second: twenty times what crystals drift apart, and a camera that
counts frames instead of time is followed 20 s after it dropped one of 25 Hz."""
SPACING_MAX_S = 0.1
"""A longer pause between two frames is forgotten as if it were so long."""


class FrameClock:
    """Of one connection; a new one begins anew."""

    def __init__(self) -> None:
        self._last_s = -math.inf
        self._offset_s = math.inf
        self._beaten_at_s = -math.inf

    def stamp(self, camera_s: float, arrival_s: float) -> float | None:
        """When, by our clock, the frame would have arrived had it not waited; None while that is not known.

        ``camera_s``: the camera's stamp, seconds from any origin; ``arrival_s``: our monotonic time at reading.
        """
        if camera_s <= self._last_s:  # the camera's clock began anew
            self._offset_s = math.inf
        elif math.isfinite(self._offset_s):
            self._offset_s += FORGETTING * min(camera_s - self._last_s, SPACING_MAX_S)
        self._last_s = camera_s
        offset_s = arrival_s - camera_s
        if offset_s < self._offset_s - BEATEN_S:
            self._beaten_at_s = arrival_s
        self._offset_s = min(self._offset_s, offset_s)
        return None if arrival_s - self._beaten_at_s < SETTLED_S else camera_s + self._offset_s
