"""What a mission needs of a PX4, shown on our endpoint and on every autopilot in COVRECON_PX4_URLS.

One flight, in the order of this file; each test leaves the vehicle as the next one finds it. An autopilot of the user's
must stand on the ground, disarmed, with some metres of room: it takes off, flies slowly and lands.
"""

from __future__ import annotations

import math
import os
import socket
from collections.abc import Callable, Iterator

import pytest
from mavsdk.plugins.action import ActionError
from mavsdk.plugins.gimbal import ControlMode, GimbalError, GimbalMode, SendMode
from mavsdk.plugins.telemetry import FlightMode, LandedState

from faults.mavsdk_client import SET_MESSAGE_INTERVAL, Client, wait, watch
from faults.ports import free_port
from protocol.mission import Drone, Mission
from protocol.vehicle_settings import Vehicles
from sim_bridge.px4_endpoint.endpoint import Endpoint
from sim_bridge.px4_endpoint.frames import unproject

pytestmark = [pytest.mark.light, pytest.mark.timeout(60)]

URLS = [url for url in os.environ.get("COVRECON_PX4_URLS", "").split(",") if url]
OTHERS = [pytest.param(url, id=url) for url in URLS] or [
    pytest.param("", id="px4", marks=pytest.mark.skip("COVRECON_PX4_URLS names no autopilot"))
]
OURS = "endpoint"

GIMBAL = 1
GIMBAL_ATTITUDE = 285
TAKEOFF_M = 2.5
HOLD_ON_LOSS = 5
SPEED_MPS = 0.5


@pytest.fixture(scope="module", params=[OURS, *OTHERS])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def url(backend: str) -> Iterator[str]:
    if backend != OURS:
        yield backend
        return
    address = f"udpin://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    mission = Mission(
        drones=(Drone(id=7, start=(1.0, 2.0, 2.0, 0.0, 1.3), url=address),),
        vehicles=Vehicles(kind="px4", origin=(47.4, 8.5, 400.0)),
    )
    with Endpoint(mission):
        yield address


class Flight:
    """The connection that is open now; a test may close it and open another."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.client = Client(url)

    def reconnect(self) -> Client:
        self.client = Client(self.url)
        return self.client


@pytest.fixture(scope="module")
def flight(url: str) -> Iterator[Flight]:
    new = Flight(url)
    try:
        yield new
    finally:
        new.client.close()


@pytest.fixture
def vehicle(flight: Flight, backend: str, record_property: Callable[[str, object], None]) -> Client:
    record_property("backend", backend if backend == OURS else f"PX4 {backend}")
    return flight.client


@pytest.mark.feature("discovery")
def test_it_is_found_by_its_heartbeat(vehicle: Client) -> None:
    assert vehicle.discovery_s < 10
    assert vehicle.system.get_system_id() > 0
    assert vehicle.system.has_autopilot()


@pytest.mark.feature("health")
def test_all_checks_turn_green(vehicle: Client) -> None:
    wait(vehicle.telemetry.health_all_ok, 30, "health_all_ok")
    assert vehicle.telemetry.health().is_armable


@pytest.mark.feature("parameters")
def test_whole_and_real_parameters_are_kept_as_set(vehicle: Client) -> None:
    parameters = vehicle.parameters
    parameters.set_param_int("COM_OBL_RC_ACT", HOLD_ON_LOSS)
    parameters.set_param_float("MNT_RANGE_PITCH", 180.0)
    vehicle.action.set_takeoff_altitude(TAKEOFF_M)
    assert parameters.get_param_int("COM_OBL_RC_ACT") == HOLD_ON_LOSS
    assert parameters.get_param_float("MNT_RANGE_PITCH") == 180.0
    assert vehicle.action.get_takeoff_altitude() == pytest.approx(TAKEOFF_M)


@pytest.mark.feature("battery")
def test_it_says_how_full_its_battery_is(vehicle: Client) -> None:
    wait(lambda: 0 < vehicle.telemetry.battery().remaining_percent <= 100, 5, "a share of the battery")
    assert vehicle.telemetry.battery().voltage_v > 3


@pytest.mark.feature("one frame through the global origin")
def test_its_local_position_and_its_global_origin_give_its_global_position(vehicle: Client) -> None:
    telemetry = vehicle.telemetry
    wait(lambda: math.isfinite(telemetry.position().latitude_deg), 5, "a global position")
    wait(lambda: math.isfinite(vehicle.height_m), 5, "a local position")
    origin, local = telemetry.get_gps_global_origin(), telemetry.position_velocity_ned().position
    told = telemetry.position()
    made = unproject(
        (origin.latitude_deg, origin.longitude_deg, origin.altitude_m), (local.north_m, local.east_m, local.down_m)
    )
    assert made[0] == pytest.approx(told.latitude_deg, abs=5e-6)  # half a metre
    assert made[1] == pytest.approx(told.longitude_deg, abs=1e-5)
    assert made[2] == pytest.approx(told.absolute_altitude_m, abs=0.5)


@pytest.mark.feature("streams at the rate asked for")
def test_positions_come_as_often_as_asked_for(vehicle: Client) -> None:
    came = []
    vehicle.telemetry.set_rate_position_velocity_ned(50.0)
    handle = vehicle.telemetry.subscribe_position_velocity_ned(lambda sample, _: came.append(sample))
    watch(1.0)
    vehicle.telemetry.unsubscribe_position_velocity_ned(handle)
    assert 35 <= len(came) <= 60


@pytest.mark.feature("gimbal control must be taken")
def test_the_gimbal_obeys_only_who_has_taken_control(vehicle: Client) -> None:
    wait(lambda: vehicle.gimbal.gimbal_list().gimbals, 20, "a gimbal")
    with pytest.raises(GimbalError):
        vehicle.gimbal.set_angles(GIMBAL, 0.0, -30.0, 0.0, GimbalMode.YAW_FOLLOW, SendMode.ONCE)
    vehicle.gimbal.take_control(GIMBAL, ControlMode.PRIMARY)


@pytest.mark.feature("gimbal angles")
@pytest.mark.parametrize(("pitch_deg", "how"), [(-45.0, SendMode.ONCE), (-80.0, SendMode.STREAM)])
def test_the_gimbal_points_where_it_is_told(vehicle: Client, pitch_deg: float, how: SendMode) -> None:
    assert vehicle.command(SET_MESSAGE_INTERVAL, GIMBAL_ATTITUDE, 50_000) == 0
    vehicle.gimbal.set_angles(GIMBAL, 0.0, pitch_deg, 0.0, GimbalMode.YAW_FOLLOW, how)

    def there() -> bool:
        angle = vehicle.gimbal.get_attitude(GIMBAL).euler_angle_forward
        return bool(abs(angle.pitch_deg - pitch_deg) < 3)

    wait(there, 5, f"a gimbal at {pitch_deg} degrees")


@pytest.mark.feature("offboard on the ground needs setpoints to arm")
def test_offboard_without_setpoints_is_acknowledged_but_arming_is_refused(vehicle: Client) -> None:
    assert vehicle.command_offboard() == 0
    vehicle.wait_for_mode(FlightMode.OFFBOARD, 3)
    with pytest.raises(ActionError):
        vehicle.action.arm()
    vehicle.action.hold()
    vehicle.wait_for_mode(FlightMode.HOLD, 3)
    assert not vehicle.telemetry.armed()


@pytest.mark.feature("status texts")
def test_it_says_why_arming_was_refused(vehicle: Client) -> None:
    wait(lambda: vehicle.heard("Resolve system health failures first"), 3, "a reason")


@pytest.mark.feature("arming and take-off")
def test_it_arms_takes_off_and_holds_near_the_height_asked_for(vehicle: Client) -> None:
    vehicle.action.arm()
    vehicle.action.takeoff()
    vehicle.wait_for_mode(FlightMode.TAKEOFF, 5)
    vehicle.wait_for_mode(FlightMode.HOLD, 20)
    assert vehicle.telemetry.armed()
    assert vehicle.height_m == pytest.approx(TAKEOFF_M, abs=1.2)
    wait(lambda: vehicle.telemetry.landed_state() == LandedState.IN_AIR, 3, "landed state IN_AIR")


@pytest.mark.feature("no disarming in the air")
def test_it_does_not_disarm_in_the_air(vehicle: Client) -> None:
    with pytest.raises(ActionError):
        vehicle.action.disarm()
    assert vehicle.telemetry.armed()


@pytest.mark.feature("offboard acknowledged but refused")
def test_offboard_without_setpoints_is_acknowledged_in_the_air_but_not_flown(vehicle: Client) -> None:
    assert vehicle.command_offboard() == 0
    wait(lambda: vehicle.heard("Switching to Offboard"), 3, "a reason")
    watch(1.2)  # a heartbeat, which alone tells the mode
    assert vehicle.mode is FlightMode.HOLD


@pytest.mark.feature("offboard velocity and yaw")
def test_it_flies_the_velocity_and_the_yaw_it_is_sent(vehicle: Client) -> None:
    yaw_deg = (vehicle.telemetry.attitude_euler().yaw_deg + 90 + 180) % 360 - 180
    vehicle.send_velocity(SPEED_MPS, 0.0, 0.0, yaw_deg)
    vehicle.offboard.start()
    vehicle.wait_for_mode(FlightMode.OFFBOARD, 3)
    watch(1.0)
    before = vehicle.telemetry.position_velocity_ned().position
    watch(2.0)
    after = vehicle.telemetry.position_velocity_ned().position
    assert (after.north_m - before.north_m) / 2 == pytest.approx(SPEED_MPS, abs=0.15)
    assert after.east_m - before.east_m == pytest.approx(0, abs=0.4)
    turn = vehicle.telemetry.attitude_euler().yaw_deg - yaw_deg
    assert abs((turn + 180) % 360 - 180) < 8


@pytest.mark.feature("hold")
def test_it_holds_its_place_when_offboard_is_ended(vehicle: Client) -> None:
    vehicle.offboard.stop()
    vehicle.wait_for_mode(FlightMode.HOLD, 3)
    watch(1.0)
    before = vehicle.telemetry.position_velocity_ned().position
    watch(1.0)
    after = vehicle.telemetry.position_velocity_ned().position
    moved = math.dist((before.north_m, before.east_m, before.down_m), (after.north_m, after.east_m, after.down_m))
    assert moved < 0.4


@pytest.mark.feature("holds when setpoints stop")
def test_it_holds_when_whoever_sent_the_setpoints_is_gone(vehicle: Client, flight: Flight) -> None:
    yaw_deg = vehicle.telemetry.attitude_euler().yaw_deg
    vehicle.send_velocity(-SPEED_MPS, 0.0, 0.0, yaw_deg)
    vehicle.offboard.start()
    vehicle.wait_for_mode(FlightMode.OFFBOARD, 3)
    vehicle.close()
    successor = flight.reconnect()
    successor.wait_for_mode(FlightMode.HOLD, 4)
    wait(lambda: abs(successor.telemetry.position_velocity_ned().velocity.north_m_s) < 0.15, 4, "standstill")
    wait(successor.telemetry.armed, 3, "a heartbeat that says armed")
    assert successor.height_m == pytest.approx(TAKEOFF_M, abs=1.2)


@pytest.mark.feature("landing and disarming")
def test_it_lands_and_disarms_by_itself(vehicle: Client) -> None:
    vehicle.action.land()
    vehicle.wait_for_mode(FlightMode.LAND, 3)
    wait(lambda: vehicle.telemetry.landed_state() == LandedState.ON_GROUND, 25, "landed state ON_GROUND")
    wait(lambda: not vehicle.telemetry.armed(), 10, "disarming")
