"""Whole teams under the paper's controller: how fast importance falls, and that nobody comes too near."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numba import njit

from faults.team_flight import TeamFlight
from protocol.geometry import Floats
from protocol.importance import ImportanceField, SamplingTerms
from protocol.mission import Drone, Flight, Mission


@pytest.mark.parametrize(("drones", "half_s", "quarter_s"), [(1, 101.0, 187.0), (4, 44.0, 72.0)])
def test_importance_falls_as_fast_as_measured_on_the_paper_s_equations(
    drones: int, half_s: float, quarter_s: float
) -> None:
    """The reference times of the plain equations: bounds +-0.5, no feedback; mean over four first headings.

    A single flight is chaotic: with these headings its times lie between -6 and +7 % of the reference. The paper says
    where the first drone starts; the others stand in a row beside it.
    """
    halves, quarters = [], []
    for yaw in (0.0, math.pi / 2, math.pi, -math.pi / 2):
        row = tuple(Drone(id=k + 1, start=(1.1 * k, 1.0, 2.0, yaw, 1.3)) for k in range(drones))
        flight = TeamFlight(Mission(drones=row))
        halves.append(flight.time_to(0.5, limit_s=300))
        quarters.append(flight.time_to(0.25, limit_s=300))
        assert drones == 1 or flight.min_separation >= 1.0
    assert np.mean(halves) == pytest.approx(half_s, rel=0.1)
    assert np.mean(quarters) == pytest.approx(quarter_s, rel=0.1)


starts = st.tuples(
    st.floats(-3.9, 3.9), st.floats(-3.9, 3.9), st.floats(0.6, 4.9), st.floats(-3.1, 3.1), st.floats(1.06, 1.56)
)


@st.composite
def missions(draw: st.DrawFn) -> Mission:
    """Random teams at random starts, from just above the separation on, with vehicles quick and slow."""
    response = draw(st.sampled_from([0.0, 0.1, 0.15, 0.25]))
    speed = draw(st.sampled_from([0.3, 0.5, 0.8]))
    flight = Flight(
        response_time_s=response,
        speed_max_mps=speed,
        acceleration_max_mps2=max(4.0, speed / response if response else 4.0),
        separation_m=draw(st.sampled_from([0.6, 1.0, 1.3])),
    )
    chosen: list[tuple[float, ...]] = []
    for start in draw(st.lists(starts, min_size=2, max_size=7)):
        if all(math.dist(start[:3], other[:3]) >= flight.separation_m for other in chosen):
            chosen.append(start)
    if len(chosen) < 2:
        chosen = [(-1.0, 0.0, 2.0, 0.0, 1.3), (1.0, 0.0, 2.0, 0.0, 1.3)]
    drones = tuple(Drone(id=number, start=start) for number, start in enumerate(chosen, start=1))
    return Mission(flight=flight, drones=drones)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
@given(mission=missions())
def test_drones_keep_their_separation_from_any_start(mission: Mission) -> None:
    flight = TeamFlight(mission)
    for _ in range(120):
        flight.step()
    assert flight.min_separation >= mission.flight.separation_m


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
@given(mission=missions())
def test_drones_keep_their_separation_from_one_that_fell_silent(mission: Mission) -> None:
    flight = TeamFlight(mission, silent=frozenset({0}))
    for _ in range(120):
        flight.step()
    assert flight.min_separation >= mission.flight.separation_m


class Lure:
    """Stands in for the field of a team of two: whatever either does, it wants to be where the other is."""

    def advance(self, poses: np.ndarray, _dt: float, own: int) -> SamplingTerms:
        towards = np.append(poses[1 - own, :3] - poses[own, :3], [0.0, 0.0])
        return SamplingTerms(1e4 * towards, 0.0, 0.0)

    def owned_cells(self, poses: np.ndarray) -> np.ndarray:
        return np.full(len(poses), 1e7)


@pytest.mark.parametrize("offset_m", [0.0, 0.1])
def test_drones_that_are_driven_at_each_other_stay_apart(offset_m: float) -> None:
    """Worst case for the lag: they meet at full speed, head-on or nearly so."""
    mission = Mission(
        drones=(Drone(id=1, start=(-2.0, 0.0, 2.0, 0.0, 1.3)), Drone(id=2, start=(2.0, offset_m, 2.0, 0.0, 1.3)))
    )
    flight = TeamFlight(mission)
    flight.replicas = [cast("ImportanceField", Lure()), cast("ImportanceField", Lure())]
    fastest = 0.0
    for _ in range(400):
        flight.step()
        fastest = max(fastest, *(abs(body.velocity[0]) for body in flight.bodies))
    assert fastest > 0.99 * mission.flight.speed_max_mps
    assert 1.0 <= flight.min_separation < 1.1
    assert flight.outcomes.count("solved") >= 0.95 * len(flight.outcomes), "rows nearly parallel are slow to solve"


def test_every_replica_integrates_the_same_field() -> None:
    flight = TeamFlight(
        Mission(drones=tuple(Drone(id=k, start=(1.5 * k - 4, 0.0, 2.0, 0.0, 1.3)) for k in range(1, 5)))
    )
    for _ in range(100):
        flight.step()
    assert len({replica.sha256 for replica in flight.replicas}) == 1


@njit(cache=True)
def dense_decay(
    phi: Floats,
    positions: Floats,
    directions: Floats,
    pose: Floats,
    sigmas: tuple[float, float, float],
    distance: float,
    rate: float,
) -> None:
    """Eqs. (1) and (2) for one drone over every cell in float64; past e^-45 a factor is 1 to the last bit."""
    axis = (np.cos(pose[3]) * np.cos(pose[4]), np.sin(pose[3]) * np.cos(pose[4]), -np.sin(pose[4]))
    for i in range(positions.shape[0]):
        d = positions[i] - pose[:3]
        r = np.sqrt((d * d).sum())
        c1 = (axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2]) / r
        position = (1 - c1) ** 2 / (2 * sigmas[0] ** 2) + (r - distance) ** 2 / (2 * sigmas[2] ** 2)
        if position > 45:
            continue
        for j in range(directions.shape[0]):
            c2 = -(directions[j, 0] * d[0] + directions[j, 1] * d[1] + directions[j, 2] * d[2]) / r
            exponent = position + (1 - c2) ** 2 / (2 * sigmas[1] ** 2)
            if exponent < 45:
                phi[i, j] *= np.exp(-rate * np.exp(-exponent))


def test_importance_over_600_s_equals_the_dense_formula() -> None:
    flight = TeamFlight(Mission(drones=(Drone(id=1, start=(0.0, 1.0, 2.0, 0.0, 1.3)),)))
    field, sensing = flight.replicas[0].field, flight.mission.sensing
    phi, positions = np.ones(field.shape), field.positions()
    sigmas = (sensing.sigma_axis, sensing.sigma_view, sensing.sigma_distance_m)
    for tick in range(12_000):
        pose = flight.bodies[0].pose.copy()
        flight.step()
        dense_decay(phi, positions, field.directions, pose, sigmas, sensing.distance_m, sensing.decay_per_s * 0.05)
        if tick % 20 == 0:
            assert flight.importance == pytest.approx(phi.mean(), abs=1e-4)
    assert flight.importance < 0.05
