"""What a few flights say about all that might be flown: means with their spread, differences with their interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Spread:
    mean: float
    """NaN if nothing is known."""
    deviation: float
    """Standard deviation of the sample (n - 1); NaN of fewer than two."""
    known: int
    """How many values there are ..."""
    count: int
    """... of so many flights; the others have none, such as the time to a J that they did not reach."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Mean of paired differences, and half the width of its confidence interval; NaN of fewer than two pairs."""

    mean: float
    half_width: float
    count: int


def spread_of(values: Sequence[float]) -> Spread:
    """NaN is a value that there is not."""
    known = np.array([value for value in values if math.isfinite(value)])
    return Spread(
        mean=float(known.mean()) if len(known) else math.nan,
        deviation=float(known.std(ddof=1)) if len(known) > 1 else math.nan,
        known=len(known),
        count=len(values),
    )


def paired_difference(first: Sequence[float], second: Sequence[float], confidence: float = CONFIDENCE) -> Difference:
    """``second`` minus ``first``, pair by pair, by Student's t distribution; pairs with a NaN are left out."""
    from scipy.stats import t

    differences = np.array(second, np.float64) - np.array(first, np.float64)
    differences = differences[np.isfinite(differences)]
    count = len(differences)
    if count < 2:
        return Difference(float(differences.mean()) if count else math.nan, math.nan, count)
    error = float(differences.std(ddof=1)) / math.sqrt(count)
    return Difference(float(differences.mean()), float(t.ppf((1 + confidence) / 2, count - 1)) * error, count)
