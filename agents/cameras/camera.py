"""What a drone's agent needs of a real camera, whatever it is plugged into."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Frame:
    image: NDArray[np.uint8]
    """(height, width, 3), RGB."""
    stamp_s: float
    """When it arrived, `time.monotonic`, without what it lay in queues: `mission.camera.latency_s` after exposure."""


class Camera(Protocol):
    """Belongs to one thread; ``close`` may be called from any, and twice."""

    def read(self) -> Frame | None:
        """The newest frame that was not read yet. Waits a while for one; None: there was none, but nothing is wrong.

        Raises:
            VehicleError: there is no picture, and why. May be called again: a camera that can come back, does.
        """
        ...

    def close(self) -> None: ...
