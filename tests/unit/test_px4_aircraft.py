"""Whole flights of the endpoint's vehicle without a link, in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from protocol.mission import Drone, Mission
from protocol.vehicle_settings import Autopilot, Vehicles
from sim_bridge.px4_endpoint.aircraft import HOME, Aircraft
from sim_bridge.px4_endpoint.battery import Battery
from sim_bridge.px4_endpoint.frames import world_yaw
from sim_bridge.px4_endpoint.guidance import Target
from sim_bridge.px4_endpoint.modes import Mode

DT = 0.01
START = (1.0, 2.0, 2.0, 0.4, 1.3)
ORIGIN = (47.0, 8.0, 400.0)
QUIET = Autopilot(position_noise_m=0.0)


class Flight:
    """An aircraft and its time; ``setpoint`` is repeated at every step, as long as there is one."""

    def __init__(
        self,
        *,
        origin: tuple[float, float, float] | None = ORIGIN,
        settings: Autopilot = QUIET,
        swap_s: float = 0.0,
        **parameters: float,
    ) -> None:
        drone = Drone(id=1, start=START)
        vehicles = Vehicles(kind="px4", origin=origin, battery_swap_s=swap_s)
        mission = Mission(drones=(drone,), vehicles=vehicles, autopilot=settings)
        self.aircraft = Aircraft(mission, drone)
        for name, value in {"COM_OBL_RC_ACT": 5, "MIS_TAKEOFF_ALT": 2.0, **parameters}.items():
            self.aircraft.parameters.set(name, value)
        self.now_s = 0.0
        self.setpoint: Target | None = None
        self.run(0.1)

    def run(self, seconds: float) -> None:
        self.until(lambda: False, seconds, required=False)

    def until(self, condition: Callable[[], bool], patience_s: float, *, required: bool = True) -> None:
        for _ in range(round(patience_s / DT)):
            if condition():
                return
            self.now_s += DT
            if self.setpoint is not None:
                self.aircraft.aim(self.setpoint, self.now_s)
            self.aircraft.step(self.now_s, DT)
        assert not required, f"not within {patience_s} s"

    @property
    def mode(self) -> Mode:
        return self.aircraft.commander.mode

    def command(self, mode: Mode) -> bool:
        return self.aircraft.commander.command(mode, self.aircraft.situation)

    def take_off(self) -> None:
        assert self.aircraft.commander.arm(self.aircraft.situation)
        assert self.command(Mode.TAKEOFF)
        self.until(lambda: self.mode is Mode.HOLD, 20)
        self.run(4)

    def fly(self, north: float, east: float, down: float, yaw: float = math.nan) -> None:
        self.setpoint = Target(None, (north, east, down), yaw, math.nan)
        self.run(DT)
        assert self.command(Mode.OFFBOARD)


def test_it_stands_below_its_start_looking_where_the_camera_shall_look() -> None:
    x, y, z, yaw, pitch = Flight().aircraft.pose
    assert (x, y, z, yaw) == pytest.approx((START[0], START[1], 0.0, START[3]))
    assert pitch == 0  # the gimbal has not been told yet


def test_its_local_frame_starts_where_it_stands_and_its_global_origin_says_where_that_is() -> None:
    aircraft = Flight().aircraft
    assert aircraft.estimate.position == pytest.approx((0.0, 0.0, 0.0))
    assert math.radians(aircraft.origin[0] - ORIGIN[0]) * 6371000 == pytest.approx(START[1], abs=1e-3)


def test_without_an_origin_its_local_frame_is_the_worlds() -> None:
    aircraft = Flight(origin=None).aircraft
    assert aircraft.estimate.position == pytest.approx((START[1], START[0], 0.0))
    assert aircraft.origin == HOME


def test_it_takes_off_to_the_height_asked_for_after_its_spool_up() -> None:
    flight = Flight(settings=Autopilot(position_noise_m=0.0, spool_up_s=2.0))
    flight.aircraft.commander.arm(flight.aircraft.situation)
    flight.command(Mode.TAKEOFF)
    flight.run(1.9)
    assert flight.aircraft.pose[2] == 0
    flight.until(lambda: flight.mode is Mode.HOLD, 20)
    assert flight.aircraft.pose[2] == pytest.approx(1.2, abs=0.1)  # NAV_MC_ALT_RAD below
    flight.run(6)
    assert flight.aircraft.pose[2] == pytest.approx(2.0, abs=0.05)


def test_it_flies_velocities_and_turns_to_the_yaw_asked_for() -> None:
    flight = Flight()
    flight.take_off()
    before = flight.aircraft.pose
    flight.fly(0.5, 0.2, -0.1, yaw=2.0)
    flight.run(4)
    after = flight.aircraft.pose
    assert after[1] - before[1] == pytest.approx(0.5 * 4, abs=0.15)
    assert after[0] - before[0] == pytest.approx(0.2 * 4, abs=0.1)
    assert after[2] - before[2] == pytest.approx(0.1 * 4, abs=0.1)
    assert after[3] == pytest.approx(world_yaw(2.0), abs=0.01)


def test_it_flies_no_faster_than_its_parameters_allow() -> None:
    flight = Flight(MPC_XY_VEL_MAX=1.0)
    flight.take_off()
    flight.fly(50.0, 0.0, 0.0)
    flight.run(3)
    assert flight.aircraft.body.velocity[0] == pytest.approx(1.0, abs=0.01)


def test_a_yaw_that_is_not_given_is_kept() -> None:
    flight = Flight()
    flight.take_off()
    before = flight.aircraft.body.yaw
    flight.fly(0.3, 0.0, 0.0)
    flight.run(2)
    assert flight.aircraft.body.yaw == pytest.approx(before)


def test_offboard_takes_off_from_the_ground_too() -> None:
    flight = Flight()
    flight.fly(0.0, 0.0, -0.5)
    assert flight.aircraft.commander.arm(flight.aircraft.situation)
    flight.run(6)
    assert flight.aircraft.pose[2] > 1.0


def test_when_setpoints_stop_it_holds_and_goes_on_when_they_come_back() -> None:
    flight = Flight()
    flight.take_off()
    flight.fly(0.5, 0.0, 0.0)
    flight.run(1)
    flight.setpoint = None
    modes = []
    for wait_s in (0.9, 2):
        flight.run(wait_s)
        modes.append(flight.mode)
    assert modes == [Mode.OFFBOARD, Mode.HOLD]
    assert math.hypot(*flight.aircraft.body.velocity) < 0.05
    flight.setpoint = Target(None, (0.3, 0.0, 0.0), math.nan, math.nan)
    flight.run(1)
    assert flight.mode is Mode.OFFBOARD


def test_without_a_remote_control_position_mode_sinks_lands_and_disarms() -> None:
    flight = Flight(COM_OBL_RC_ACT=0)
    flight.take_off()
    flight.fly(0.2, 0.0, 0.0)
    flight.setpoint = None
    flight.until(lambda: flight.mode is Mode.POSCTL, 2)
    flight.until(lambda: not flight.aircraft.commander.armed, 12)
    assert flight.aircraft.pose[2] == 0


def test_landing_takes_time_and_ends_disarmed() -> None:
    flight = Flight()
    flight.take_off()
    began = flight.now_s
    flight.command(Mode.LAND)
    flight.until(lambda: flight.aircraft.ground.landed, 15)
    assert flight.now_s - began > 2.0 / 0.7
    assert flight.aircraft.commander.armed
    flight.until(lambda: not flight.aircraft.commander.armed, 3)


def test_it_returns_to_where_it_armed_and_lands_there() -> None:
    flight = Flight()
    flight.take_off()
    flight.fly(1.0, 1.0, 0.0)
    flight.run(4)
    assert math.dist(flight.aircraft.pose[:2], START[:2]) > 4
    flight.setpoint = None
    flight.command(Mode.RTL)
    flight.until(lambda: not flight.aircraft.commander.armed, 60)
    assert math.dist(flight.aircraft.pose[:2], START[:2]) < 0.4


def test_it_stops_at_its_fence() -> None:
    flight = Flight(GF_ACTION=2, GF_MAX_HOR_DIST=3.0)
    flight.take_off()
    flight.fly(1.0, 0.0, 0.0)
    flight.until(lambda: flight.mode is Mode.HOLD, 10)
    flight.run(2)
    assert 3.0 < flight.aircraft.estimate.position[0] < 4.0


def test_a_push_carries_it_away_against_its_will() -> None:
    flight = Flight()
    flight.take_off()
    flight.aircraft.push((2.0, 0.0, 0.0), seconds=2.0)
    before = flight.aircraft.pose[1]
    flight.run(0.5)
    assert flight.aircraft.estimate.velocity[0] > 1.0
    flight.run(1.5)
    assert flight.aircraft.pose[1] - before > 1.5
    flight.run(8)
    assert flight.aircraft.pose[1] == pytest.approx(before, abs=0.1)


def test_a_jump_moves_the_estimate_and_not_the_vehicle() -> None:
    flight = Flight()
    flight.take_off()
    true, believed = flight.aircraft.pose, flight.aircraft.estimate.position
    flight.aircraft.jump((3.0, 0.0, 0.0))
    assert flight.aircraft.estimate.position[0] == pytest.approx(believed[0] + 3.0)
    flight.run(3)
    assert flight.aircraft.pose == pytest.approx(true, abs=0.05)


def test_a_pilots_sticks_fly_it_in_position_mode() -> None:
    flight = Flight()
    flight.take_off()
    flight.aircraft.guidance.sticks = (0.0, 0.0, 0.0)
    flight.command(Mode.POSCTL)
    flight.run(3)
    assert flight.aircraft.pose[2] == pytest.approx(2.0, abs=0.1)


def test_its_battery_empties_in_flight_only() -> None:
    flight = Flight(settings=Autopilot(position_noise_m=0.0, battery_s=100.0))
    flight.run(5)
    assert flight.aircraft.battery.share == 1.0
    flight.take_off()
    flying_s = flight.now_s - flight.aircraft.commander.armed_s
    assert flight.aircraft.battery.share == pytest.approx(1 - flying_s / 100, abs=0.001)


def test_the_same_mission_flies_the_same() -> None:
    poses = []
    for _ in range(2):
        flight = Flight(settings=Autopilot(gust_mps=1.0, wind_mps=(1.0, 2.0)))
        flight.take_off()
        poses.append(flight.aircraft.pose)
    assert poses[0] == poses[1]


def test_it_holds_within_what_its_estimate_is_worth() -> None:
    flight = Flight(settings=Autopilot(position_noise_m=0.05))
    flight.take_off()
    flight.run(10)
    assert 0 < math.dist(flight.aircraft.pose[:3], (START[0], START[1], 2.0)) < 0.4


def swapped(power_off_s: float) -> Flight:
    """It has flown elsewhere and stands there, its battery changed a second ago or just now."""
    flight = Flight(settings=Autopilot(position_noise_m=0.0, battery_s=60.0, power_off_s=power_off_s), swap_s=3.0)
    aircraft = flight.aircraft
    aircraft.gimbal.configure((245, 190), (245, 190))
    flight.take_off()
    flight.fly(0.5, 0.0, 0.0)
    flight.run(2.0)
    flight.setpoint = None
    assert flight.command(Mode.LAND)
    flight.until(lambda: not aircraft.commander.armed, 20.0)
    assert aircraft.battery.share < 0.9
    flight.run(2.9)
    assert aircraft.battery.share < 0.9, "the crew is at it"
    flight.run(0.2)
    assert aircraft.battery.share == 1.0
    return flight


def test_an_autopilot_that_is_fed_goes_on_with_another_battery() -> None:
    flight = swapped(power_off_s=0.0)
    aircraft, origin = flight.aircraft, flight.aircraft.origin
    assert not aircraft.is_off
    flight.run(10.0)
    assert (aircraft.boots, aircraft.booted_s, aircraft.origin) == (0, 0.0, origin)
    assert aircraft.gimbal.controller == (245, 190)
    assert aircraft.knows_battery
    assert aircraft.battery.share == 1.0


def test_an_autopilot_without_power_begins_anew_where_it_stands() -> None:
    flight = swapped(power_off_s=4.0)
    aircraft, began = flight.aircraft, flight.aircraft.origin
    place = aircraft.body.position
    assert aircraft.is_off
    flight.until(lambda: not aircraft.is_off, 4.1)
    assert aircraft.boots == 1
    assert aircraft.up_s == pytest.approx(0.0, abs=2 * DT)
    assert not aircraft.knows_battery
    assert aircraft.gimbal.controller == (0, 0), "nobody"
    assert aircraft.parameters["COM_OBL_RC_ACT"] == 5, "it keeps its parameters"
    assert aircraft.estimate.position == pytest.approx((0.0, 0.0, 0.0)), "of its own local frame"
    assert aircraft.body.position == place
    north_m = math.radians(aircraft.origin[0] - began[0]) * 6_371_000.0
    assert north_m > 0.5, "which lies elsewhere now"
    flight.run(2.1)
    assert aircraft.knows_battery
    flight.take_off()


def test_it_may_wake_up_elsewhere() -> None:
    flight = swapped(power_off_s=1.0)
    flight.aircraft.boot_error = (0.0, 2.0, 0.0)
    flight.run(1.1)
    assert flight.aircraft.estimate.position == pytest.approx((0.0, 2.0, 0.0))


def test_nobody_changes_a_battery_that_has_not_flown_or_without_a_spare() -> None:
    flight = Flight(settings=QUIET, swap_s=3.0)
    flight.aircraft.battery.share = 0.5
    flight.run(5.0)
    assert flight.aircraft.battery.share == 0.5
    battery = Battery(10.0, swap_s=1.0, spares=1)
    for full in (True, False):
        battery.drain(2.0)
        assert any(battery.stand(0.5) for _ in range(4)) is full


# --- external vision -------------------------------------------------------------------------------------------------

DRIFTING = Autopilot(position_noise_m=0.0, drift_mps=0.2)


def off_m(aircraft: Aircraft) -> float:
    return math.dist(aircraft.estimate.position, aircraft.body.position)


def seen(flight: Flight, seconds: float, late_s: float = 0.0) -> None:
    """By a capture with fifty poses a second."""
    places = [flight.aircraft.body.position] * (1 + round(late_s / 0.02))
    for _ in range(round(seconds / 0.02)):
        flight.run(0.02)
        places.append(flight.aircraft.body.position)
        flight.aircraft.see(places[-1 - round(late_s / 0.02)], 0, flight.now_s)


def test_an_estimate_that_drifts_is_kept_by_what_is_seen_and_drifts_on_without() -> None:
    flight = Flight(origin=None, settings=DRIFTING)
    flight.run(5.0)
    assert off_m(flight.aircraft) == pytest.approx(5.1 * 0.2, rel=0.01)
    seen(flight, 5.0)
    assert off_m(flight.aircraft) < 0.01
    flight.run(5.0)
    assert off_m(flight.aircraft) < 0.05, "the drift has been learned"


def test_axes_that_are_not_fused_drift_on() -> None:
    flight = Flight(origin=None, settings=DRIFTING, EKF2_EV_CTRL=2)
    seen(flight, 5.0)
    error = [a - b for a, b in zip(flight.aircraft.estimate.position, flight.aircraft.body.position, strict=True)]
    assert abs(error[2]) < 0.01
    assert math.hypot(error[0], error[1]) > 0.1


def test_without_satellites_there_is_no_position_before_it_is_seen_nor_long_after() -> None:
    flight = Flight(origin=None, settings=Autopilot(position_noise_m=0.0, satellites=False))
    assert not flight.aircraft.has_position
    assert flight.aircraft.red == ("No valid local position estimate",)
    flight.aircraft.see((4.0, 5.0, -1.0), 0, flight.now_s)
    assert flight.aircraft.estimate.position == pytest.approx((4.0, 5.0, -1.0)), "its frame is what sees it"
    assert (flight.aircraft.has_position, flight.aircraft.red) == (True, ())
    flight.run(5.1)
    assert not flight.aircraft.has_position


def test_another_reset_counter_moves_the_estimate_at_once() -> None:
    flight = Flight(origin=None)
    here = flight.aircraft.body.position
    flight.aircraft.see((here[0] + 1.0, here[1], here[2]), 0, flight.now_s)
    assert 0.1 < off_m(flight.aircraft) < 0.3
    flight.aircraft.see((here[0] + 1.0, here[1], here[2]), 1, flight.now_s)
    assert off_m(flight.aircraft) == pytest.approx(1.0)


@pytest.mark.parametrize(("delay_ms", "wrong_m"), [(0.0, 0.1), (200.0, 0.0)])
def test_the_delay_that_the_parameter_says_is_flown_on(delay_ms: float, wrong_m: float) -> None:
    flight = Flight(origin=None, EKF2_EV_DELAY=delay_ms)
    flight.take_off()
    flight.fly(0.5, 0.0, 0.0)
    seen(flight, 6.0, late_s=0.2)
    assert off_m(flight.aircraft) == pytest.approx(wrong_m, abs=0.03)
