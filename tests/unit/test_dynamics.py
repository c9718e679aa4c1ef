"""Simulated vehicles follow the first-order model that the barriers are built on, within their limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.geometry import Floats
from protocol.mission import Flight
from sim_bridge.dynamics import VehicleBody

DT = 0.05
FLIGHT = Flight(response_time_s=0.15, acceleration_max_mps2=4.0, angular_acceleration_max_radps2=8.0)
COMMAND = np.array([0.3, -0.2, 0.1, 0.25, -0.15])
reproducible = settings(derandomize=True, deadline=None)
speeds = st.tuples(*[st.floats(-0.5, 0.5)] * 5).map(np.array)


def body(flight: Flight = FLIGHT, command: Floats = COMMAND) -> VehicleBody:
    new = VehicleBody.at(np.array([1.0, 2.0, 3.0, 0.5, 1.2]))
    new.command(command, 0.0, flight)
    return new


def test_a_vehicle_starts_at_rest() -> None:
    start = np.array([1.0, 2.0, 3.0, 0.5, 1.2])
    new = VehicleBody.at(start)
    new.step(DT, 0.0, FLIGHT)

    assert new.pose == pytest.approx(start)
    assert not new.velocity.any()
    assert start.tolist() == [1.0, 2.0, 3.0, 0.5, 1.2]


@pytest.mark.parametrize("ticks", [1, 4, 10])
def test_the_response_is_the_exact_solution_of_the_first_order_lag(ticks: int) -> None:
    """v = u (1 - exp(-t / tau)), p = p0 + u (t - tau (1 - exp(-t / tau)))."""
    flown = body()
    start = flown.pose.copy()
    for tick in range(ticks):
        flown.step(DT, tick * DT, FLIGHT)

    t, tau = ticks * DT, FLIGHT.response_time_s
    risen = 1 - math.exp(-t / tau)
    assert flown.velocity == pytest.approx(COMMAND * risen, rel=1e-12)
    assert flown.pose - start == pytest.approx(COMMAND * (t - tau * risen), rel=1e-9)


@reproducible
@given(velocity=speeds, command=speeds)
def test_the_predicted_pose_moves_exactly_as_commanded(velocity: Floats, command: Floats) -> None:
    """y = p + tau v obeys dy/dt = u: what the barriers of `agents.barriers` rest on."""
    flight = Flight(response_time_s=0.15, acceleration_max_mps2=10.0, angular_acceleration_max_radps2=10.0)
    flown = body(flight, command)
    flown.velocity = velocity
    before = flown.pose + flight.response_time_s * flown.velocity

    flown.step(DT, 0.0, flight)

    assert flown.pose + flight.response_time_s * flown.velocity == pytest.approx(before + DT * command, abs=1e-12)


@reproducible
@given(velocity=speeds, command=speeds, response=st.sampled_from([0.0, 0.01, 0.05, 0.15, 0.5]))
def test_no_axis_accelerates_more_than_its_limit(velocity: Floats, command: Floats, response: float) -> None:
    """Limits as low as a mission may have them; then a vehicle at full speed that is to turn about reaches them."""
    least = 0.5 / (response or 1.0)
    flight = Flight(response_time_s=response, acceleration_max_mps2=least, angular_acceleration_max_radps2=1.25 * least)
    limit = least * np.array([1, 1, 1, 1.25, 1.25])
    flown = body(flight, command)
    flown.velocity = velocity

    flown.step(DT, 0.0, flight)

    assert (np.abs(flown.velocity - velocity) <= DT * limit + 1e-12).all()
    between = np.minimum(velocity, command) - 1e-12, np.maximum(velocity, command) + 1e-12
    assert (between[0] <= flown.velocity).all()
    assert (flown.velocity <= between[1]).all(), "it never overshoots"


def test_a_vehicle_at_its_acceleration_limit_travels_as_a_uniformly_accelerated_body() -> None:
    flight = Flight(response_time_s=0.1, acceleration_max_mps2=5.0)
    flown = body(flight, np.array([0.5, 0, 0, 0, 0]))
    flown.velocity = np.array([-0.5, 0, 0, 0, 0])

    flown.step(DT, 0.0, flight)

    assert flown.velocity[0] == pytest.approx(-0.5 + 5.0 * DT)
    assert flown.pose[0] - 1.0 == pytest.approx(-0.5 * DT + 5.0 * DT**2 / 2)


def test_a_vehicle_without_lag_flies_the_command_at_once() -> None:
    flight = Flight(response_time_s=0.0, acceleration_max_mps2=100.0, angular_acceleration_max_radps2=100.0)
    flown = body(flight)

    flown.step(DT, 0.0, flight)

    assert flown.velocity == pytest.approx(COMMAND)
    assert flown.pose == pytest.approx(np.array([1.0, 2.0, 3.0, 0.5, 1.2]) + DT * COMMAND)


def test_a_command_beyond_the_input_bounds_is_clipped() -> None:
    flown = body(command=np.array([9.0, -9.0, 0.1, 9.0, -9.0]))

    assert flown.commanded.tolist() == [0.5, -0.5, 0.1, 0.5, -0.5]


def test_a_vehicle_brakes_once_its_setpoints_have_timed_out_and_not_before() -> None:
    flown = body()
    flown.step(DT, FLIGHT.setpoint_timeout_s, FLIGHT)
    assert flown.commanded == pytest.approx(COMMAND)

    speed = np.abs(flown.velocity)
    for tick in range(1, 100):
        flown.step(DT, FLIGHT.setpoint_timeout_s + tick * DT, FLIGHT)
        assert (np.abs(flown.velocity) < speed).all()
        speed = np.abs(flown.velocity)
    assert speed.max() < 1e-12


def test_a_vehicle_that_braked_flies_on_with_the_next_setpoint() -> None:
    flown = body()
    flown.step(DT, 10.0, FLIGHT)
    flown.command(COMMAND, 10.0, FLIGHT)
    flown.step(DT, 10.0, FLIGHT)

    assert (flown.velocity * COMMAND > 0).all()


@pytest.mark.parametrize(("yaw", "rate"), [(math.pi - 0.01, 0.5), (-math.pi + 0.01, -0.5)])
def test_yaw_wraps_at_half_a_turn_and_nothing_else_jumps(yaw: float, rate: float) -> None:
    flown = VehicleBody.at(np.array([0.0, 0.0, 2.0, yaw, 1.3]))
    flown.command(np.array([0, 0, 0, rate, 0]), 0.0, FLIGHT)
    turned = yaw
    for tick in range(10):
        before = flown.pose[3]
        flown.step(DT, tick * DT, FLIGHT)
        assert -math.pi <= flown.pose[3] <= math.pi
        turned += math.remainder(flown.pose[3] - before, 2 * math.pi)

    assert abs(turned) > math.pi
    assert math.remainder(turned - flown.pose[3], 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    assert flown.pose[[0, 1, 2, 4]].tolist() == [0.0, 0.0, 2.0, 1.3]


def test_a_vehicle_that_lands_comes_down_whatever_is_commanded_and_stays_on_the_ground() -> None:
    flown = body(command=np.array([0.5, 0.5, 0.5, 0.0, 0.0]))
    flown.landing = True
    lowest, path = 9.0, []
    for tick in range(400):
        flown.command(np.array([0.5, 0.5, 0.5, 0.0, 0.0]), tick * DT, FLIGHT)
        flown.step(DT, tick * DT, FLIGHT)
        lowest = min(lowest, float(flown.pose[2]))
        path.append(flown.pose[:2].copy())

    assert flown.pose[2] == pytest.approx(0.0, abs=0.03)
    assert lowest > -0.02
    assert path[-1] == pytest.approx(path[0]), "straight down"
    assert np.abs(flown.velocity).max() < 1e-3
