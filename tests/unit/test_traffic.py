"""The traffic that is planned: complete, of real sizes, and growing with the team as it does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents import agent
from deploy.traffic_command import figures, traffic
from ground_station import ground_station
from protocol import topics, traffic_samples
from protocol.formation import formation
from protocol.geometry import camera_rotation
from protocol.keyframe_rule import KeyframeRule
from protocol.localization_settings import Localization
from protocol.map_settings import Camera
from protocol.mission import Drone, Flight, Mission
from protocol.mission_file import mission_to_toml
from protocol.obstacle_settings import Obstacles
from protocol.topics import TOPICS
from protocol.traffic import (
    HEAD_EVERY_TICKS,
    HEADER_BYTES,
    IRREGULAR,
    PHASE_PERIOD_S,
    Carrier,
    Plan,
    default_depth_bytes,
    default_jpeg_bytes,
    keyframe_rate_hz,
    radio_bytes_per_s,
    traffic_of,
)
from protocol.vehicle_settings import Vehicles
from protocol.wire import decode, encode

WIDE = Flight(lower_m=(-30.0, -30.0, 0.5), upper_m=(30.0, 30.0, 5.0))


def team(count: int, **settings: Any) -> Mission:
    starts = formation(WIDE, count, [])
    drones = tuple(Drone(id=number, start=start) for number, start in enumerate(starts, start=1))
    return Mission(flight=WIDE, drones=drones, **settings)


def with_obstacles() -> Mission:
    return Mission(flight=Flight(obstacles=Obstacles(enabled=True)), drones=team(1).drones)


def with_camera(count: int) -> Mission:
    mission = team(count, vehicles=Vehicles(kind="px4"))
    seeing = mission.drones[0].model_copy(update={"camera": "/dev/video0"})
    return mission.model_copy(update={"drones": (seeing, *mission.drones[1:])})


# --- what is counted -------------------------------------------------------------------------------------------------


def test_every_topic_of_an_agent_is_planned_or_known_to_be_irregular() -> None:
    planned = {
        (flow.topic, flow.direction)
        for mission in (
            team(4),
            team(9),
            with_camera(2),
            with_obstacles(),
            team(1, localization=Localization(source="lidar")),
            team(1, localization=Localization(source="mocap")),
        )
        for flow in traffic_of(mission, 1).flows
    }
    regular = [topic for topic in TOPICS if topic not in IRREGULAR]

    assert planned == {(topic.key, "up") for topic in regular if "agent" in topic.writers} | {
        (topic.key, "down") for topic in regular if "agent" in topic.readers
    }


def test_rates_are_those_of_the_processes_that_speak() -> None:
    assert ground_station.HEAD_EVERY_TICKS == HEAD_EVERY_TICKS
    assert ground_station.STATUS_PERIOD_S == PHASE_PERIOD_S
    assert agent.EARLIER_STATES == traffic_samples.EARLIER


def test_samples_are_messages_that_travel() -> None:
    mission = team(9)
    samples = [
        traffic_samples.state(255),
        traffic_samples.team_states(mission),
        traffic_samples.tick(mission),
        traffic_samples.setpoint(9),
        traffic_samples.scan(mission, 9),
        traffic_samples.external_pose(9),
        traffic_samples.keyframe(mission, 9, 1000),
        traffic_samples.head(),
        traffic_samples.phase(),
        traffic_samples.digest(mission),
        traffic_samples.jump(mission),
    ]
    limits = {topic.message: topic.max_bytes for topic in TOPICS}
    for sample in samples:
        encoded = encode(sample)
        assert encode(decode(type(sample), encoded)) == encoded
        assert len(encoded) < limits[type(sample)]


def test_of_simulated_vehicles_the_tick_tells_and_setpoints_go_to_the_simulator() -> None:
    simulated, flying = traffic_of(team(4), 1), traffic_of(team(4, vehicles=Vehicles(kind="px4")), 1)

    assert topics.SETPOINT.key in {flow.topic for flow in simulated.flows}
    assert topics.SETPOINT.key not in {flow.topic for flow in flying.flows}
    assert simulated.bytes_per_s("down") > flying.bytes_per_s("down")


def test_images_travel_from_drones_that_have_cameras_or_where_a_size_is_given() -> None:
    mission = with_camera(2)
    image = {drone: [f for f in traffic_of(mission, drone).flows if f.topic == topics.KEYFRAME.key] for drone in (1, 2)}

    assert [flow.message_bytes > default_jpeg_bytes(mission) for flow in image[1]] == [True]
    assert not image[2]
    (given,) = [f for f in traffic_of(team(2), 2, Plan(jpeg_bytes=50_000)).flows if f.topic == topics.KEYFRAME.key]
    assert 50_000 < given.message_bytes < 50_500


def test_the_image_of_a_depth_camera_travels_with_it() -> None:
    plain = team(1)
    deep = plain.model_copy(update={"camera": Camera(depth=True)})
    sizes = [
        next(f for f in traffic_of(mission, 1, Plan(jpeg_bytes=20_000)).flows if f.topic == topics.KEYFRAME.key)
        for mission in (plain, deep)
    ]
    grown = sizes[1].message_bytes - sizes[0].message_bytes
    assert grown == pytest.approx(default_depth_bytes(deep), abs=8)
    assert default_depth_bytes(plain) == 0


# --- what it comes to ------------------------------------------------------------------------------------------------


def down(count: int, *, gathered: bool) -> float:
    return traffic_of(team(count, vehicles=Vehicles(kind="px4")), 1, Plan(gathered=gathered)).bytes_per_s("down")


def test_gathered_states_grow_with_the_team_at_less_than_a_third_of_the_direct_ones_price() -> None:
    direct = (down(64, gathered=False) - down(32, gathered=False)) / 32
    gathered = (down(64, gathered=True) - down(32, gathered=True)) / 32

    assert 15_000 < direct < 18_000, "20 states a second"
    assert gathered < direct / 3


def test_the_mission_says_from_when_on_states_are_gathered() -> None:
    keys = [{flow.topic for flow in traffic_of(team(count), 1).flows} for count in (8, 9)]

    assert topics.TEAM.key not in keys[0]
    assert topics.STATE.key in keys[0]
    assert topics.TEAM.key in keys[1]


def test_the_radio_carries_what_all_drones_say_and_hear() -> None:
    mission = team(5)
    one = traffic_of(mission, 2)

    assert radio_bytes_per_s(mission) == pytest.approx(5 * (one.bytes_per_s("up") + one.bytes_per_s("down")), rel=1e-3)


def test_acknowledgements_travel_against_what_they_are_for() -> None:
    few, many = traffic_of(team(2), 1), traffic_of(team(8), 1)

    assert few.acknowledgements("down") == pytest.approx(many.acknowledgements("down"))
    assert many.acknowledgements("up") > 2 * few.acknowledgements("up")


def test_what_carries_messages_is_counted_as_it_was_measured() -> None:
    """Bytes of the TCP stream: as seen by `ss` on a loopback link."""
    plain = Carrier(tls=False)
    assert [plain.stream_bytes(size) - size for size in (10, 100, 700, 5_000, 20_000)] == [15, 15, 16, 16, 17]
    assert plain.stream_bytes(70_000) - 70_000 == 28, "27 were seen"
    assert plain.stream_bytes(700, key_bytes=9) - 700 == 25, "drone/3/state, heard under drone/*/state"
    assert Carrier().stream_bytes(700) - plain.stream_bytes(700) == 22
    assert Carrier().stream_bytes(20_000) - plain.stream_bytes(20_000) == 44, "two records"
    assert [plain.segments(size) for size in (1, 1448, 1449)] == [1, 1, 2]
    assert Carrier(mtu_bytes=65_536).segments(60_000) == 1
    assert HEADER_BYTES == 52


@pytest.mark.parametrize("speed_mps", [0.11, 0.45, 0.7])
def test_images_come_as_often_as_the_rule_takes_them(speed_mps: float) -> None:
    mission = team(1)
    rule, step = KeyframeRule(mission.camera), speed_mps * mission.tick_s
    ticks = 4_000
    taken = sum(rule.wants(np.array([step * k, 0.0, 1.0]), camera_rotation(0.0, 1.3)) for k in range(ticks))

    assert keyframe_rate_hz(mission, speed_mps) == pytest.approx(taken / (ticks * mission.tick_s), rel=0.02)


def test_a_camera_that_stands_takes_none_and_one_that_turns_takes_them_by_its_angle() -> None:
    assert keyframe_rate_hz(team(1), 0.0) == 0.0
    wide = team(1).model_copy(update={"camera": Camera(keyframe_baseline_m=100.0, keyframe_angle_rad=0.5)})
    assert keyframe_rate_hz(wide) == pytest.approx(1.0), "half a radian at half a radian a second"


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "nine.toml"
    path.write_text(mission_to_toml(team(9)))
    return path


def test_the_command_tells_each_topic_the_sums_and_the_shares(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    traffic(file)
    told = capsys.readouterr().out

    for key in ("drone/{drone}/state", "team/states", "clock/tick", "acknowledgements", "in all", "20 Mbit/s"):
        assert key in told
    assert "9 drones, states gathered by the router" in told


def test_the_command_tells_machines_the_same(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    traffic(file, drones=12, jpeg_kb=80, speed_mps=0.3, as_json=True)
    told = json.loads(capsys.readouterr().out)

    assert told["drones"] == 12
    assert told["topics"]["drone/{drone}/keyframe"]["messages"] == pytest.approx(2.5)
    for direction in ("up", "down"):
        total = sum(row[direction] for row in told["topics"].values())
        assert told[f"{direction}_bytes_per_s"] == pytest.approx(total, abs=2)
    assert told["radio_bytes_per_s"] == pytest.approx(
        12 * (told["up_bytes_per_s"] + told["down_bytes_per_s"]), rel=0.01
    )
    assert told["shares"]["20 Mbit/s"]["radio"] == pytest.approx(8e-6 * told["radio_bytes_per_s"] / 20, abs=1e-4)


def test_the_drone_with_a_camera_is_the_one_that_is_shown() -> None:
    mission = with_camera(3)
    last = mission.model_copy(update={"drones": tuple(reversed(mission.drones))})

    assert figures(last, Plan())["drone"] == 1
