"""What a simulated vehicle believes of itself: the truth, a slow error that wanders, and noise."""

from __future__ import annotations

import math

import numpy as np

from protocol.geometry import Floats
from protocol.localization_settings import EstimateNoise

ESTIMATE_STREAM = 13
"""Keeps the draws of estimates apart from others that are made from the same seed."""


class EstimateError:
    """Of one vehicle. Slow errors are first-order Gauss-Markov processes that begin at none: the start is known."""

    def __init__(self, settings: EstimateNoise, seed: int, drone: int, tick_s: float) -> None:
        self._settings = settings
        self._generator = np.random.default_rng([seed, ESTIMATE_STREAM, drone])
        self._kept = math.exp(-tick_s / settings.drift_s)
        self._scale = np.array([settings.drift_m] * 3 + [settings.drift_rad, 0.0] + [settings.velocity_mps] * 3)
        self._slow = np.zeros(8)
        self._white = np.zeros(5)
        self._grown = 0.0
        """Share of their variance that the slow errors have reached."""

    def step(self) -> None:
        """To the next tick."""
        settings, fresh = self._settings, math.sqrt(1 - self._kept**2)
        self._slow = self._kept * self._slow + fresh * self._scale * self._generator.standard_normal(8)
        self._white = np.array([settings.white_m] * 3 + [settings.white_rad] * 2) * self._generator.standard_normal(5)
        self._grown = 1 - (1 - self._grown) * self._kept**2

    def pose(self, truth: Floats) -> Floats:
        """(5,)"""
        believed: Floats = truth + self._slow[:5] + self._white
        believed[3] = math.remainder(believed[3], math.tau)
        return believed

    def velocity(self, truth: Floats) -> Floats:
        """(5,)"""
        believed = truth.copy()
        believed[:3] += self._slow[5:]
        return believed

    @property
    def deviations(self) -> tuple[float, float]:
        """Standard deviations of position and angles, m and rad, as an estimator with the right model knows them."""
        settings, share = self._settings, math.sqrt(self._grown)
        return math.hypot(share * settings.drift_m, settings.white_m), math.hypot(
            share * settings.drift_rad, settings.white_rad
        )
