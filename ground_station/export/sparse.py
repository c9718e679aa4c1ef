"""Points for methods that optimise a scene to begin from: drawn from the map, as there was no structure from motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ground_station.export.meshes import sample
from ground_station.export.source import Source
from protocol.errors import CovreconError


def sparse_points(source: Source, count: int) -> tuple[NDArray[np.void] | None, tuple[str, ...]]:
    """``count`` records of `CLOUD_POINT`; None, and a note that says why, if there is no map or none are wished."""
    if not count:
        return None, ()
    try:
        return sample(source.mesh(), count), ()
    except CovreconError as error:
        return None, (f"without points: {error}",)
