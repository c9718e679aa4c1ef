"""What the endpoint's vehicle says on its link, what it answers, and what its faults do to both."""

from __future__ import annotations

import math
import socket
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.errors import MissionError
from protocol.mission import Drone, Mission
from protocol.vehicle_settings import Vehicles
from sim_bridge.px4_endpoint.dialect import Packet, mavlink
from sim_bridge.px4_endpoint.endpoint import Endpoint
from sim_bridge.px4_endpoint.modes import Mode
from sim_bridge.px4_endpoint.truth import Truth
from sim_bridge.px4_endpoint.vehicle import Vehicle

DT = 0.01
GROUND = (245, 190)
NAN = math.nan


class Ground:
    """The other end of one vehicle's link, and the vehicle's time."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._codec = mavlink.MAVLink(None, *GROUND)
        url = f"udpin://127.0.0.1:{self._socket.getsockname()[1]}"
        drone = Drone(id=3, start=(1.0, 2.0, 2.0, 0.4, 1.3), url=url)
        self.vehicle = Vehicle(
            Mission(drones=(drone,), vehicles=Vehicles(kind="px4", origin=(47.0, 8.0, 400.0))), drone
        )
        self.now_s = 100.0
        self.system = self.vehicle.link.system

    def run(self, seconds: float) -> list[Packet]:
        """What the vehicle sends meanwhile."""
        heard: list[Packet] = []
        for _ in range(round(seconds / DT)):
            self.now_s += DT
            self.vehicle.step(self.now_s, DT)
            heard += self.hear()
        return heard

    def hear(self) -> list[Packet]:
        packets: list[Packet] = []
        while True:
            try:
                packets += self._codec.parse_buffer(self._socket.recv(4096)) or []
            except BlockingIOError:
                return packets

    def send(self, packet: Packet) -> list[Packet]:
        """Hand ``packet`` to the vehicle; what it answers."""
        self._socket.sendto(packet.pack(self._codec), self.vehicle.link.socket.getsockname())
        self.vehicle.read(self.now_s)
        return self.hear()

    def command(self, number: int, *arguments: float) -> list[Packet]:
        padded = (*arguments, *[0.0] * (7 - len(arguments)))
        return self.send(mavlink.MAVLink_command_long_message(self.system, 1, number, 0, *padded))

    def setpoint(self, north: float, east: float, down: float) -> None:
        only_velocity_and_yaw = 0b100111000111
        velocity, rest = (north, east, down), [0.0] * 5
        frame = mavlink.MAV_FRAME_LOCAL_NED
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, self.system, 1, frame, only_velocity_and_yaw, 0.0, 0.0, 0.0, *velocity, *rest
            )
        )

    def close(self) -> None:
        self.vehicle.close()
        self._socket.close()


@pytest.fixture
def ground() -> Iterator[Ground]:
    new = Ground()
    new.run(0.1)
    yield new
    new.close()


def kinds(packets: list[Packet]) -> Counter[str]:
    return Counter(packet.get_type() for packet in packets)


def results(packets: list[Packet]) -> list[int]:
    return [packet.result for packet in packets if packet.get_type() == "COMMAND_ACK"]


def texts(packets: list[Packet]) -> str:
    return "".join(packet.text for packet in packets if packet.get_type() == "STATUSTEXT")


def newest(packets: list[Packet], kind: str) -> Any:
    return [packet for packet in packets if packet.get_type() == kind][-1]


def test_messages_come_at_px4s_rates(ground: Ground) -> None:
    heard = kinds(ground.run(10.0))
    wanted = {"HEARTBEAT": 10, "SYS_STATUS": 50, "LOCAL_POSITION_NED": 300, "ATTITUDE": 1000, "HOME_POSITION": 5}
    for kind, count in wanted.items():
        assert heard[kind] == pytest.approx(count, rel=0.05, abs=1), kind


def test_every_message_is_from_the_autopilot_of_its_system(ground: Ground) -> None:
    assert {(p.get_srcSystem(), p.get_srcComponent()) for p in ground.run(2.0)} == {(3, 1)}


def test_a_message_comes_as_often_as_it_is_asked_for(ground: Ground) -> None:
    attitude = mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS
    assert results(ground.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, 50_000)) == [0]
    assert kinds(ground.run(2.0))["GIMBAL_DEVICE_ATTITUDE_STATUS"] == pytest.approx(40, abs=1)
    ground.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, -1)
    assert kinds(ground.run(2.0))["GIMBAL_DEVICE_ATTITUDE_STATUS"] == 0
    ground.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, 0)
    assert kinds(ground.run(2.0))["GIMBAL_DEVICE_ATTITUDE_STATUS"] == 2


@pytest.mark.parametrize("number", [0, 148, 242, 280, 283])
def test_a_message_asked_for_is_sent_after_the_acknowledgement(ground: Ground, number: int) -> None:
    acknowledgement, answer = ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, number)
    assert acknowledgement.result == 0
    assert answer.get_msgId() == number


def test_what_it_does_not_know_it_calls_unsupported(ground: Ground) -> None:
    assert results(ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 9999)) == [3]
    assert results(ground.command(mavlink.MAV_CMD_NAV_WAYPOINT)) == [3]


def test_all_parameters_are_listed_once(ground: Ground) -> None:
    heard = ground.send(mavlink.MAVLink_param_request_list_message(3, 1))
    assert len({packet.param_id for packet in heard}) == len(heard) == heard[0].param_count > 40


def test_a_parameter_of_the_wrong_kind_is_refused_in_words(ground: Ground) -> None:
    real = mavlink.MAV_PARAM_TYPE_REAL32
    assert "mismatch" in texts(ground.send(mavlink.MAVLink_param_set_message(3, 1, b"COM_OBL_RC_ACT", 5.0, real)))
    assert "unknown" in texts(ground.send(mavlink.MAVLink_param_set_message(3, 1, b"NO_SUCH", 5.0, real)))


def test_long_texts_come_in_chunks(ground: Ground) -> None:
    ground.vehicle.deny_arming = True
    heard = ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    assert results(heard) == [1]
    heard += ground.run(0.1)
    chunks = [packet for packet in heard if packet.get_type() == "STATUSTEXT"]
    assert texts(heard) == "Arming denied: Resolve system health failures first"
    assert [chunk.chunk_seq for chunk in chunks] == [0, 1]
    assert len({chunk.id for chunk in chunks}) == 1 != chunks[0].id - 1


def test_packets_for_another_system_are_left_alone(ground: Ground) -> None:
    packet = mavlink.MAVLink_command_long_message(4, 1, mavlink.MAV_CMD_NAV_LAND, 0, *[0.0] * 7)
    assert ground.send(packet) == []


@pytest.mark.parametrize("value", [NAN, math.inf, -math.inf, 1e30, -1.0])
def test_no_argument_of_a_command_or_setpoint_disturbs_it(ground: Ground, value: float) -> None:
    for number in (176, 400, 21, 22, 20, 511, 512, 1000, 1001):
        ground.command(number, *[value] * 7)
    ground.setpoint(value, value, value)
    ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    ground.run(3.0)
    assert all(map(math.isfinite, ground.vehicle.pose))


def test_rubbish_on_its_port_does_no_harm(ground: Ground) -> None:
    dice = np.random.default_rng(1)
    for _ in range(200):
        ground._socket.sendto(dice.bytes(60), ground.vehicle.link.socket.getsockname())
    ground.vehicle.read(ground.now_s)
    ground.hear()
    assert results(ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 0)) == [0]


def test_setpoints_are_told_to_who_listens_with_the_time_of_their_arrival(ground: Ground) -> None:
    heard: list[float] = []
    ground.vehicle.on_setpoint = lambda drone, now_s, _: heard.extend((drone, now_s))
    for _ in range(3):
        ground.setpoint(0.1, 0.0, 0.0)
        ground.run(0.05)
    assert heard == pytest.approx([3, 100.1, 3, 100.15, 3, 100.2])
    summary = ground.vehicle.setpoints.summary()
    assert summary["setpoints"] == 3
    assert summary["gap_s"] == {name: pytest.approx(0.05) for name in ("p50", "p99", "max")}


def take_off(ground: Ground) -> None:
    ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    ground.command(mavlink.MAV_CMD_NAV_TAKEOFF)
    ground.run(10.0)
    assert ground.vehicle.mode is Mode.HOLD


def test_a_silent_vehicle_hears_and_a_cut_one_does_not(ground: Ground) -> None:
    ground.vehicle.silent = True
    assert ground.run(2.0) == []
    ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    assert ground.vehicle.armed
    ground.vehicle.cut = True
    ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0)
    assert ground.vehicle.armed
    ground.vehicle.cut = False
    assert ground.run(2.0)


def test_a_red_check_is_told_and_keeps_it_from_arming(ground: Ground) -> None:
    ground.vehicle.fail_checks("gps")
    health = newest(ground.run(1.0), "SYS_STATUS").onboard_control_sensors_health
    assert not health & mavlink.MAV_SYS_STATUS_SENSOR_GPS
    assert not health & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    assert results(ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)) == [1]
    ground.vehicle.fail_checks()
    assert results(ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)) == [0]


def test_a_battery_that_is_set_is_told(ground: Ground) -> None:
    ground.vehicle.set_battery(0.2)
    heard = ground.run(3.0)
    assert newest(heard, "BATTERY_STATUS").battery_remaining == 20
    assert newest(heard, "SYS_STATUS").battery_remaining == 20


def test_refused_offboard_is_acknowledged(ground: Ground) -> None:
    take_off(ground)
    ground.vehicle.refuse_offboard = True
    ground.setpoint(0.1, 0.0, 0.0)
    heard = ground.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
    assert results(heard) == [0]
    assert ground.vehicle.mode is Mode.HOLD
    assert "Switching to Offboard" in texts(heard)


def test_a_pilot_takes_it_and_gives_it_back(ground: Ground) -> None:
    take_off(ground)
    ground.setpoint(0.0, 0.0, 0.0)
    ground.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
    modes = [ground.vehicle.mode]
    for mode in ("POSCTL", "OFFBOARD"):
        ground.vehicle.pilot(mode)
        ground.setpoint(0.0, 0.0, 0.0)
        ground.run(0.5)
        modes.append(ground.vehicle.mode)
    assert modes == [Mode.OFFBOARD, Mode.POSCTL, Mode.OFFBOARD]
    with pytest.raises(KeyError):
        ground.vehicle.pilot("NO_SUCH")


def test_a_jump_is_in_what_it_tells_and_not_in_the_truth(ground: Ground) -> None:
    before, true = newest(ground.run(0.1), "LOCAL_POSITION_NED"), ground.vehicle.pose
    ground.vehicle.jump((2.0, 0.0, 0.0))  # east
    after = newest(ground.run(0.1), "LOCAL_POSITION_NED")
    assert after.y - before.y == pytest.approx(2.0, abs=0.01)
    assert ground.vehicle.pose == true


def test_a_push_moves_it_in_truth(ground: Ground) -> None:
    take_off(ground)
    before = ground.vehicle.pose
    ground.vehicle.push((0.0, 3.0, 0.0), 1.0)
    ground.run(1.0)
    assert ground.vehicle.pose[1] - before[1] > 1.5


def test_a_silent_gimbal_answers_nothing(ground: Ground) -> None:
    ground.vehicle.gimbal_silent = True
    assert "GIMBAL_DEVICE_ATTITUDE_STATUS" not in kinds(ground.run(3.0))
    assert results(ground.command(mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE, 245, 190, -1, -1, 0, 0, 1)) == []
    assert results(ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 280)) == [3]


def test_a_stuck_gimbal_reports_but_does_not_move(ground: Ground) -> None:
    ground.command(mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE, 245, 190, -1, -1, 0, 0, 1)
    ground.vehicle.gimbal_stuck = True
    assert results(ground.command(mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, -30, 0, NAN, NAN, 0, 0, 1)) == [0]
    assert newest(ground.run(2.0), "GIMBAL_DEVICE_ATTITUDE_STATUS").q == [1.0, 0.0, 0.0, 0.0]
    ground.vehicle.gimbal_stuck = False
    assert newest(ground.run(2.0), "GIMBAL_DEVICE_ATTITUDE_STATUS").q[2] < -0.2


def test_the_truth_of_a_flight_is_written(ground: Ground, tmp_path: Path) -> None:
    truth = Truth([ground.vehicle])
    for _ in range(100):
        ground.run(DT)
        truth.watch(ground.now_s)
    truth.write(tmp_path)
    with np.load(tmp_path / "vehicles.npz") as file:
        assert file["ids"].tolist() == [3]
        assert file["poses"].shape == (*file["times"].shape, 1, 5)
        assert np.diff(file["times"]) == pytest.approx(0.05, abs=0.0101)
        assert file["poses"][-1, 0] == pytest.approx(ground.vehicle.pose)
    assert '"min_separation_m": null' in (tmp_path / "vehicles.json").read_text()


def test_two_vehicles_in_the_air_have_a_separation() -> None:
    drones = tuple(Drone(id=n, start=(2.0 * n, 0.0, 2.0, 0.0, 1.3), url=f"udpin://127.0.0.1:{9 + n}") for n in (1, 2))
    endpoint = Endpoint(Mission(drones=drones))
    for vehicle in endpoint.vehicles.values():
        vehicle.aircraft.ground.landed = False
    endpoint.truth.watch(1.0)
    endpoint.stop()
    assert endpoint.truth.separation_m == pytest.approx(2.0)


def test_a_connection_of_another_kind_is_refused() -> None:
    with pytest.raises(MissionError, match="udpin"):
        Endpoint(Mission(drones=(Drone(id=1, start=(0.0, 0.0, 2.0, 0.0, 1.3), url="tcpout://127.0.0.1:5760"),)))
