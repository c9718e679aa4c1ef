"""Stretches of time in which something holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats


@dataclass(frozen=True, slots=True)
class Spell:
    start_s: float
    end_s: float
    """Of the first tick in which it does not hold any more, or of the last tick of all."""
    first: int
    behind: int
    """Ticks [first, behind) by index."""


def spells(time_s: Floats, holds: NDArray[np.bool_], bridged_s: float = 0.0) -> list[Spell]:
    """All spells of ``holds`` (T,) at ``time_s`` (T,), ascending; gaps of up to ``bridged_s`` count as held."""
    bounds = np.flatnonzero(np.diff(holds, prepend=False, append=False)).reshape(-1, 2).tolist()
    ends = [*time_s.tolist(), *time_s[-1:].tolist()]
    merged: list[list[int]] = []
    for first, behind in bounds:
        if merged and ends[first] - ends[merged[-1][1]] <= bridged_s:
            merged[-1][1] = behind
        else:
            merged.append([first, behind])
    return [Spell(ends[first], ends[behind], first, behind) for first, behind in merged]
