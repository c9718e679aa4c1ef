"""Simulated motion capture: what it says of a body, how late, how wrong, and when it sees none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocol.geometry import Floats
from protocol.localization_settings import CaptureNoise, Localization, Mocap
from protocol.messages import ExternalPose
from protocol.mission import Drone, Mission, Simulation
from sim_bridge.motion_capture import SimulatedCapture

DRONES = (Drone(id=2, start=(0, 1, 2, 0, 1.3)), Drone(id=5, start=(0, -1, 2, 0, 1.3)))


def mission(noise: CaptureNoise, seed: int = 1, **capture: float) -> Mission:
    return Mission(
        seed=seed,
        localization=Localization(source="mocap"),
        mocap=Mocap.model_validate(capture),
        simulation=Simulation(mocap=noise),
        drones=DRONES,
    )


def pose(tick: int) -> Floats:
    return np.array([0.02 * tick, 1.0, 2.0, 0.01 * tick, 1.3])


def watch(capture: SimulatedCapture, ticks: int) -> list[list[ExternalPose]]:
    return [capture.look(tick, {2: pose(tick), 5: -pose(tick)}) for tick in range(ticks)]


def test_without_noise_it_says_the_truth_as_old_as_it_is() -> None:
    said = watch(SimulatedCapture(mission(CaptureNoise(noise_m=0, noise_rad=0), latency_s=0.1)), 10)
    assert [(one.drone, one.tick, one.age_s) for one in said[7]] == [(2, 7, 0.1), (5, 7, 0.1)]
    seen = said[7][0]
    assert seen.position == tuple(pose(5)[:3])
    assert seen.attitude is not None
    assert 2 * math.atan2(seen.attitude[3], seen.attitude[0]) == pytest.approx(pose(5)[3])
    assert [one[0].position is None for one in said[:4]] == [True, True, False, False], "nothing was true before"


def test_it_sees_no_more_often_than_it_can() -> None:
    said = watch(SimulatedCapture(mission(CaptureNoise(), rate_hz=5.0)), 9)
    assert [len(one) for one in said] == [2, 0, 0, 0, 2, 0, 0, 0, 2]
    assert mission(CaptureNoise()).mocap_ticks == 1, "50 a second in 20 ticks"


def test_noise_is_as_large_as_told_and_of_the_seed_alone() -> None:
    noise = CaptureNoise(noise_m=0.01)
    said = watch(SimulatedCapture(mission(noise)), 500)
    errors = [one[0].position[0] - pose(tick)[0] for tick, one in enumerate(said) if one[0].position is not None]
    assert len(errors) == 500
    assert np.std(errors) == pytest.approx(0.01, rel=0.15)
    assert said[3][0].position_sd_m == 0.01
    assert said == watch(SimulatedCapture(mission(noise)), 500)
    assert said != watch(SimulatedCapture(mission(noise, seed=2)), 500)


def test_bodies_are_lost_from_view_as_often_and_as_long_as_asked_for_each_by_itself() -> None:
    said = watch(SimulatedCapture(mission(CaptureNoise(dropouts_per_min=6.0, dropout_s=1.0))), 12_000)
    hidden = np.array([[one.position is None for one in both] for both in said])
    assert 0.06 < hidden[:, 0].mean() < 0.14, "a second in ten, now and then two of them at once"
    assert (hidden[:, 0] != hidden[:, 1]).any()
    lengths = np.diff(np.flatnonzero(np.diff(np.pad(hidden[:, 0], 1).astype(int))))[::2]
    assert min(lengths) == 20
