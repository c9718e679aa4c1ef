"""The endpoint's airframe follows velocities with the mission's lag, in the wind, and its estimate wanders as told."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocol.mission import Flight
from protocol.vehicle_settings import Autopilot
from sim_bridge.px4_endpoint.body import GRAVITY_MPS2, Body, Wind, follow
from sim_bridge.px4_endpoint.estimator import Estimator
from sim_bridge.px4_endpoint.frames import EARTH_RADIUS_M, ned, pitch_and_yaw, quaternion, unproject, world_yaw
from sim_bridge.px4_endpoint.parameters import Parameters
from sim_bridge.px4_endpoint.takeoff import Ground

DT = 0.01
FLIGHT = Flight(response_time_s=0.15, acceleration_max_mps2=4.0)
STILL = Autopilot()


def dice() -> np.random.Generator:
    return np.random.default_rng(5)


def flown(seconds: float, wanted: tuple[float, float, float], settings: Autopilot = STILL) -> Body:
    body, wind = Body((0.0, 0.0, -5.0), 0.0), Wind(settings, dice())
    for _ in range(round(seconds / DT)):
        wind.step(DT)
        body.fly(wanted, 0.0, wind, FLIGHT, DT)
    return body


def test_a_speed_approaches_what_is_wanted_with_the_time_constant() -> None:
    way, speed = follow(0.0, 0.5, 0.15, 4.0, 0.15)
    assert speed == pytest.approx(0.5 * (1 - math.exp(-1)))
    assert way == pytest.approx(0.5 * 0.15 * math.exp(-1))


def test_a_large_change_of_speed_is_limited_to_the_acceleration() -> None:
    way, speed = follow(0.0, 10.0, 0.15, 4.0, 0.1)
    assert speed == pytest.approx(0.4)
    assert way == pytest.approx(0.02)


def test_small_steps_and_a_large_one_end_at_the_same_place() -> None:
    way, speed = 0.0, 0.1
    for _ in range(10):
        part, speed = follow(speed, 0.5, 0.15, 4.0, 0.01)
        way += part
    assert (way, speed) == pytest.approx(follow(0.1, 0.5, 0.15, 4.0, 0.1))


def test_a_body_flies_the_velocity_it_is_told() -> None:
    body = flown(3.0, (0.4, -0.3, -0.2))
    assert body.velocity == pytest.approx((0.4, -0.3, -0.2), abs=1e-6)
    assert body.position == pytest.approx((0.4 * 2.85, -0.3 * 2.85, -5 - 0.2 * 2.85), abs=0.01)


def test_a_body_leans_into_a_steady_wind_and_stays() -> None:
    body = flown(3.0, (0.0, 0.0, 0.0), Autopilot(wind_mps=(0.0, 4.0)))  # blows towards north, it looks north
    assert body.position == pytest.approx((0.0, 0.0, -5.0), abs=1e-6)
    assert body.pitch > math.radians(3)  # nose up: it thrusts southwards
    assert body.roll == pytest.approx(0.0, abs=1e-9)


def test_gusts_carry_a_body_to_and_fro() -> None:
    body = flown(20.0, (0.0, 0.0, 0.0), Autopilot(gust_mps=2.0))
    assert 0.01 < math.hypot(*body.position[:2]) < 3


def test_gusts_have_the_deviation_that_the_mission_says() -> None:
    wind, seen = Wind(Autopilot(gust_mps=1.5), dice()), []
    for _ in range(4000):
        wind.step(0.5)
        seen.append(wind.gust)
    assert np.std(seen, axis=0) == pytest.approx([1.5, 1.5], rel=0.1)


def test_a_body_without_thrust_falls_and_then_stands() -> None:
    body = Body((1.0, 2.0, -1.0), 0.3)
    for _ in range(20):
        body.rest(DT)
    assert body.velocity[2] == pytest.approx(0.2 * GRAVITY_MPS2)
    for _ in range(100):
        body.rest(DT)
    assert body.on_ground
    assert body.velocity == (0.0, 0.0, 0.0)
    assert body.position == (1.0, 2.0, 0.0)


def test_an_estimate_wanders_by_the_deviation_asked_for_and_its_velocity_is_the_derivative() -> None:
    estimator, errors, rates = Estimator((0.0, 0.0, 0.0), 0.05, dice()), [], []
    for _ in range(50_000):
        errors.append(estimator.error)
        rates.append(estimator.velocity_error)
        estimator.step(0.1)
    assert np.std(errors, axis=0) == pytest.approx([0.05] * 3, rel=0.15)
    assert np.std(rates, axis=0) == pytest.approx([0.01] * 3, rel=0.15)
    assert (np.diff(errors, axis=0) / 0.1 - rates[:-1]).std() < 0.004  # what the newest noise adds within a step


def test_an_estimate_is_in_the_local_frame_and_jumps_when_told() -> None:
    estimator = Estimator((10.0, 20.0, 0.0), 0.0, dice())
    estimator.step(DT)
    assert estimator.position((11.0, 22.0, -3.0)) == (1.0, 2.0, -3.0)
    estimator.jump((0.5, 0.0, -1.0))
    assert estimator.position((11.0, 22.0, -3.0)) == (1.5, 2.0, -4.0)


def test_a_vehicle_leaves_the_ground_after_its_spool_up_and_ramps_its_climb() -> None:
    ground = Ground(Parameters(), spool_up_s=1.5)
    limits = [
        ground.step(i * DT, DT, armed_s=0.0, on_ground=i < 200, wanted_down=-1.0) for i in range(400)
    ]  # fmt: skip
    assert max(limits[:150]) == 0
    assert limits[170] > 0
    assert limits[200] < 1.0 < limits[399]
    assert not ground.landed


def test_it_counts_as_landed_after_pressing_on_the_ground_for_a_second() -> None:
    ground = Ground(Parameters(), spool_up_s=0.0)
    ground.step(0.0, DT, armed_s=0.0, on_ground=True, wanted_down=-1.0)
    ground.step(0.1, DT, armed_s=0.0, on_ground=False, wanted_down=-1.0)
    landed = []
    for i in range(150):
        ground.step(1 + i * DT, DT, armed_s=0.0, on_ground=True, wanted_down=0.7)
        landed.append(ground.landed)
    assert landed.index(True) == pytest.approx(100, abs=2)


def test_the_world_and_a_vehicles_frame_are_turned_as_the_compass_is() -> None:
    assert ned((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)
    assert world_yaw(0.0) == pytest.approx(math.pi / 2)  # north is y
    assert world_yaw(math.pi / 2) == pytest.approx(0.0)  # east is x
    assert world_yaw(world_yaw(1.1)) == pytest.approx(1.1)


def test_a_quaternion_keeps_pitch_and_yaw() -> None:
    assert pitch_and_yaw(quaternion(0.0, -1.2, 2.5)) == pytest.approx((-1.2, 2.5))


def test_a_place_a_hundred_metres_away_has_its_latitude_and_longitude() -> None:
    latitude, longitude, height = unproject((47.0, 8.0, 400.0), (100.0, 50.0, -2.0))
    assert math.radians(latitude - 47.0) * EARTH_RADIUS_M == pytest.approx(100.0, abs=0.01)
    assert math.radians(longitude - 8.0) * EARTH_RADIUS_M * math.cos(math.radians(47)) == pytest.approx(50.0, abs=0.01)
    assert height == 402.0
