"""Metrics over real HTTP: what Prometheus reads is what was told."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from dataclasses import replace
from urllib.error import URLError

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from pydantic import ValidationError

from agents.agent_metrics import AgentMetrics
from faults.ports import free_port
from faults.scrape import Series, samples, scrape, series
from ground_station.ground_metrics import GroundMetrics, MapLoad
from ground_station.recording.recorder import RecordingStatistics
from protocol.messages import Control, DroneState, DroneStatus, ReplicaState, Status
from protocol.metrics_endpoint import MetricsEndpoint, metrics_port
from protocol.mission import Drone, Mission
from protocol.operation_settings import Metrics

MISSION = Mission(name="pair", drones=(Drone(id=1, start=(0, 1, 2, 0, 1.4)), Drone(id=4, start=(0, -1, 2, 0, 1.4))))
REPLICA = ReplicaState(tick=95, epoch=7, next_jump=2, missing=3, repaired=4, lost=5)
CONTROL = Control(
    tick=99, outcome="solved", velocity=(0.1, 0, 0, 0, 0), slack=0.25, sampling=0.01, solve_s=0.003,
    separation_margin_m2=1.0, region_margin_m=1.0, pitch_margin_rad2=1.0, active=(), fallbacks=0, refused=6,
    telemetry_age_s=0.04,
)  # fmt: skip
STATE = DroneState(
    drone=4, tick=100, pose=(0, 0, 2, 0, 1.4), velocity=(0, 0, 0, 0, 0), battery=0.75, mode="flying",
    importance=0.5, replica=REPLICA, control=CONTROL,
)  # fmt: skip
STATUS = Status(
    phase="flying", activity="", tick=100, time_s=5.0, importance=0.6, f_score_visible=0.7, f_score_objects=0.8,
    keyframes=50, dropped=2, replica=REPLICA, refused=1, unwritten=3, loop_lag_s=0.004, keyframes_per_s=10.0, jumps=9,
    min_separation_m=1.2,
    drones=(
        DroneStatus(drone=4, alive=True, mode="braking", position=(0, 0, 2), speed_mps=0.1, separation_m=1.5,
                    slack=0.2, solve_s=0.002, fallbacks=11),
        DroneStatus(drone=1, alive=False, mode="waiting", position=(0, 0, 2), speed_mps=0.0, separation_m=0.0,
                    slack=0.0, solve_s=0.0, fallbacks=0),
    ),
)  # fmt: skip


RECORDED = RecordingStatistics(
    written={"/tf": 100, "/log": 3},
    dropped={"/drone/4/camera": 2},
    bytes=12345,
    worst_stall_s=0.31,
    queue=17,
    failed="",
)


def mission(port: int) -> Mission:
    return MISSION.model_copy(update={"metrics": Metrics(port=port)})


@pytest.fixture
def endpoint() -> Iterator[MetricsEndpoint]:
    with MetricsEndpoint(mission(free_port()), "ground") as open_endpoint:
        yield open_endpoint


@pytest.fixture
def registry() -> CollectorRegistry:
    return CollectorRegistry()


def read(registry: CollectorRegistry) -> dict[Series, float]:
    return samples(generate_latest(registry).decode())


def test_ports_count_up_from_the_missions() -> None:
    assert [
        metrics_port(mission(9100), "ground"),
        metrics_port(mission(9100), "sim"),
        metrics_port(mission(9100), "agent", 1),
        metrics_port(mission(9100), "agent", 4),
    ] == [9100, 9101, 9102, 9105]


def test_a_mission_without_metrics_opens_no_port() -> None:
    with MetricsEndpoint(mission(0), "agent", 4) as closed:
        AgentMetrics(closed.registry).hear(STATE)
        assert closed.port == 0


def test_an_endpoint_says_whose_it_is_and_what_the_process_costs(endpoint: MetricsEndpoint) -> None:
    found = scrape(endpoint.port)

    assert found[series("covrecon_process_info", {"mission": "pair", "kind": "ground"})] == 1
    assert found[series("process_cpu_seconds_total")] > 0
    assert found[series("process_resident_memory_bytes")] > 1e6


def test_an_endpoint_listens_on_the_loopback_device_alone(endpoint: MetricsEndpoint) -> None:
    with socket.socket() as elsewhere:
        elsewhere.bind(("127.0.0.2", endpoint.port))  # taken, if it listened everywhere


def test_a_port_that_is_taken_costs_a_warning_alone(
    endpoint: MetricsEndpoint, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING), MetricsEndpoint(mission(endpoint.port), "ground") as second:
        assert second.port == 0

    assert f"cannot listen at 127.0.0.1:{endpoint.port}: Address already in use" in caplog.text


def test_ports_beyond_the_last_are_refused_with_the_mission() -> None:
    with pytest.raises(ValidationError, match="less than or equal to 65279"):
        Metrics(port=65534)


def test_a_closed_endpoint_answers_no_more_and_frees_its_port(endpoint: MetricsEndpoint) -> None:
    port = endpoint.port
    endpoint.close()
    endpoint.close()

    with pytest.raises(URLError):
        scrape(port)
    with MetricsEndpoint(mission(port), "ground") as again:
        assert again.port == port


def test_an_agents_figures_are_those_of_its_newest_state(registry: CollectorRegistry) -> None:
    AgentMetrics(registry).hear(STATE)
    found = read(registry)

    assert found[series("covrecon_agent_tick")] == 100
    assert found[series("covrecon_agent_importance")] == 0.5
    assert found[series("covrecon_agent_battery_ratio")] == 0.75
    assert found[series("covrecon_agent_phi_lag_ticks")] == 5
    assert found[series("covrecon_agent_phi_missing_blocks")] == 3
    assert found[series("covrecon_agent_phi_repaired_blocks_total")] == 4
    assert found[series("covrecon_agent_lost_states_total")] == 5
    assert found[series("covrecon_agent_refused_messages_total")] == 6
    assert found[series("covrecon_agent_telemetry_age_seconds")] == 0.04
    assert found[series("covrecon_agent_slack")] == 0.25
    assert found[series("covrecon_agent_mode", {"mode": "flying"})] == 1
    assert found[series("covrecon_agent_mode", {"mode": "braking"})] == 0
    assert series("covrecon_agent_obstacle_margin_meters") not in found, "of a row that is not there"

    near = CONTROL.model_copy(update={"obstacle_margin_m": -0.02})
    other = CollectorRegistry()
    AgentMetrics(other).hear(STATE.model_copy(update={"control": near}))
    assert read(other)[series("covrecon_agent_obstacle_margin_meters")] == -0.02


def test_a_decision_counts_once_by_what_the_solver_said(registry: CollectorRegistry) -> None:
    metrics = AgentMetrics(registry)
    late = CONTROL.model_copy(update={"tick": 101, "outcome": "out_of_time", "solve_s": 0.07})
    for control in (None, CONTROL, CONTROL, late):
        metrics.hear(STATE.model_copy(update={"control": control}))
    found = read(registry)

    assert found[series("covrecon_agent_decisions_total", {"outcome": "solved"})] == 1
    assert found[series("covrecon_agent_decisions_total", {"outcome": "out_of_time"})] == 1
    assert found[series("covrecon_agent_solve_seconds_count")] == 2
    assert found[series("covrecon_agent_solve_seconds_sum")] == pytest.approx(0.073)
    assert found[series("covrecon_agent_solve_seconds_bucket", {"le": "0.05"})] == 1


def test_an_agent_that_has_not_decided_has_no_figures_of_decisions(registry: CollectorRegistry) -> None:
    metrics = AgentMetrics(registry)
    assert series("covrecon_agent_tick") not in read(registry)
    metrics.hear(STATE.model_copy(update={"control": None}))

    assert series("covrecon_agent_slack") not in read(registry)
    assert read(registry)[series("covrecon_agent_tick")] == 100


def test_the_missions_figures_are_those_of_the_newest_status(registry: CollectorRegistry) -> None:
    GroundMetrics(registry).hear_status(STATUS, MapLoad(backlog=8, passed_over=6, memory_bytes=7))
    found = read(registry)

    expected = {
        "tick": 100, "importance": 0.6, "keyframes_total": 50, "dropped_keyframes_total": 2, "backlog_keyframes": 8,
        "jumps_total": 9, "min_separation_meters": 1.2, "loop_lag_p99_seconds": 0.004, "refused_messages_total": 1,
        "unwritten_records_total": 3, "lost_states_total": 5, "passed_over_keyframes_total": 6, "map_memory_bytes": 7,
    }  # fmt: skip
    assert {name: found[series(f"covrecon_{name}")] for name in expected} == expected
    assert found[series("covrecon_f_score_ratio", {"surface": "visible"})] == 0.7
    assert found[series("covrecon_f_score_ratio", {"surface": "objects"})] == 0.8
    assert found[series("covrecon_phase", {"phase": "flying"})] == 1
    assert found[series("covrecon_phase", {"phase": "finished"})] == 0


def test_each_drone_has_its_own_figures(registry: CollectorRegistry) -> None:
    now_s = 50.0
    metrics = GroundMetrics(registry, now_s=lambda: now_s)
    metrics.hear_status(STATUS, MapLoad())
    metrics.hear_state(STATE)
    now_s = 50.75
    found = read(registry)

    def of(name: str, drone: int, **labels: str) -> float | None:
        return found.get(series(f"covrecon_drone_{name}", {"drone": str(drone), **labels}))

    assert of("link_age_seconds", 4) == 0.75
    assert of("battery_ratio", 4) == 0.75
    assert of("phi_lag_ticks", 4) == 5
    assert of("separation_meters", 4) == 1.5
    assert of("fallbacks_total", 4) == 11
    assert of("last_solve_seconds", 4) == 0.002
    assert (of("alive", 4), of("alive", 1)) == (1, 0)
    assert (of("mode", 4, mode="braking"), of("mode", 4, mode="waiting")) == (1, 0)
    assert of("mode", 1, mode="waiting") == 1
    assert of("link_age_seconds", 1) is None
    assert of("separation_meters", 1) is None


def test_what_the_recorder_dropped_is_told_by_channel(registry: CollectorRegistry) -> None:
    metrics = GroundMetrics(registry)
    metrics.hear_status(STATUS, MapLoad(), recording=RECORDED)
    found = read(registry)

    assert found[series("covrecon_recorded_messages_total", {"channel": "/tf"})] == 100
    assert found[series("covrecon_unrecorded_messages_total", {"channel": "/drone/4/camera"})] == 2
    assert found[series("covrecon_recorded_bytes_total")] == 12345
    assert found[series("covrecon_recorder_queue")] == 17
    assert found[series("covrecon_recorder_stall_seconds")] == 0.31
    assert found[series("covrecon_recorder_failed")] == 0

    metrics.hear_status(STATUS, MapLoad(), recording=replace(RECORDED, failed="disk full"))
    assert read(registry)[series("covrecon_recorder_failed")] == 1
