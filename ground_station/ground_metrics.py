"""The mission's figures for Prometheus, made from the status for people and the drones' states."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import get_args

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ground_station.recording.recorder import RecordingStatistics
from protocol.messages import DroneState, DroneStatus, Mode, Phase, Status

MODES = ("waiting", *get_args(Mode))
"""Of a `DroneStatus`; "waiting": never heard."""


@dataclass(frozen=True, slots=True)
class MapLoad:
    """What the map has to do, and what it takes."""

    backlog: int = 0
    """Images that wait for it."""
    passed_over: int = 0
    """Images for which it had no time."""
    memory_bytes: int = 0


class GroundMetrics(Collector):
    """All but `collect`, which a scrape's thread calls, belongs to the event loop; what passes between is immutable."""

    def __init__(self, registry: CollectorRegistry, *, now_s: Callable[[], float] = time.monotonic) -> None:
        """``now_s``: monotonic seconds, callable from any thread, by which a link's age is measured."""
        self._now_s = now_s
        self._status: Status | None = None
        self._load = MapLoad()
        self._recording: RecordingStatistics | None = None
        self._heard: dict[int, tuple[float, DroneState]] = {}
        registry.register(self)

    def hear_state(self, state: DroneState) -> None:
        self._heard[state.drone] = (self._now_s(), state)

    def hear_status(self, status: Status, load: MapLoad, *, recording: RecordingStatistics | None = None) -> None:
        self._status, self._load, self._recording = status, load, recording

    def collect(self) -> Iterator[Metric]:
        """Figures of the newest status; none before the first."""
        if self._status is not None:
            yield from _of_mission(self._status, self._load)
            yield from _of_drones(self._status.drones)
        if self._recording is not None:
            yield from _of_recording(self._recording)
        yield from self._of_links()

    def _of_links(self) -> Iterator[Metric]:
        age = GaugeMetricFamily(
            "covrecon_drone_link_age_seconds", "Since a state of the drone was last heard.", labels=["drone"]
        )
        battery = GaugeMetricFamily("covrecon_drone_battery_ratio", "Charge left, 0 to 1.", labels=["drone"])
        lag = GaugeMetricFamily(
            "covrecon_drone_phi_lag_ticks", "Ticks by which the drone's phi lags.", labels=["drone"]
        )
        now_s = self._now_s()
        for drone, (heard_s, state) in sorted(self._heard.copy().items()):  # copied in one step: the loop adds to it
            age.add_metric([str(drone)], max(0.0, now_s - heard_s))
            battery.add_metric([str(drone)], state.battery)
            lag.add_metric([str(drone)], state.tick - state.replica.tick)
        yield from (age, battery, lag)


def _of_mission(status: Status, load: MapLoad) -> Iterator[Metric]:
    gauge, counter = GaugeMetricFamily, CounterMetricFamily
    yield gauge("covrecon_tick", "Newest tick of the mission.", status.tick)
    yield gauge("covrecon_importance", "J: mean importance of all cells.", status.importance)
    score = gauge("covrecon_f_score_ratio", "F-score of the map at 5 cm; 0 without a truth.", labels=["surface"])
    score.add_metric(["visible"], status.f_score_visible)
    score.add_metric(["objects"], status.f_score_objects)
    yield score
    yield _states("covrecon_phase", "1 for the phase that the mission is in.", "phase", get_args(Phase), status.phase)
    yield counter("covrecon_keyframes", "Images that the map took in.", status.keyframes)
    yield counter("covrecon_dropped_keyframes", "Images that were lost or are of no use.", status.dropped)
    yield counter("covrecon_passed_over_keyframes", "Images for which the map had no time.", load.passed_over)
    yield gauge("covrecon_backlog_keyframes", "Images that wait for the map.", load.backlog)
    yield gauge(
        "covrecon_map_memory_bytes", "Of the map, the keyframes that it keeps, and its mesh.", load.memory_bytes
    )
    yield counter("covrecon_jumps", "Map updates that made phi jump.", status.jumps)
    yield gauge("covrecon_min_separation_meters", "Smallest distance of two drones so far.", status.min_separation_m)
    yield gauge("covrecon_loop_lag_p99_seconds", "How late the event loop wakes.", status.loop_lag_s)
    yield counter("covrecon_refused_messages", "Messages refused, not handled or without room.", status.refused)
    yield counter("covrecon_unwritten_records", "Records that the disk refused.", status.unwritten)
    yield counter("covrecon_lost_states", "States that did not come in time.", status.replica.lost)


def _of_drones(drones: Sequence[DroneStatus]) -> Iterator[Metric]:
    alive = GaugeMetricFamily("covrecon_drone_alive", "1 while the drone's process is there.", labels=["drone"])
    separation = GaugeMetricFamily("covrecon_drone_separation_meters", "To the nearest other drone.", labels=["drone"])
    slack = GaugeMetricFamily("covrecon_drone_slack", "w of the quadratic program.", labels=["drone"])
    solve = GaugeMetricFamily("covrecon_drone_last_solve_seconds", "Wall time of the last decision.", labels=["drone"])
    braking = CounterMetricFamily(
        "covrecon_drone_fallbacks", "Ticks that braked for want of a solution.", labels=["drone"]
    )
    modes = GaugeMetricFamily("covrecon_drone_mode", "1 for the mode that the drone is in.", labels=["drone", "mode"])
    for row in drones:
        drone = str(row.drone)
        alive.add_metric([drone], float(row.alive))
        if row.separation_m > 0:  # 0: there is no other
            separation.add_metric([drone], row.separation_m)
        slack.add_metric([drone], row.slack)
        solve.add_metric([drone], row.solve_s)
        braking.add_metric([drone], row.fallbacks)
        for mode in MODES:
            modes.add_metric([drone, mode], float(mode == row.mode))
    yield from (alive, separation, slack, solve, braking, modes)


def _of_recording(statistics: RecordingStatistics) -> Iterator[Metric]:
    for name, text, counts in (
        ("covrecon_recorded_messages", "Messages in the recording.", statistics.written),
        ("covrecon_unrecorded_messages", "Messages that the recorder had no time for.", statistics.dropped),
    ):
        family = CounterMetricFamily(name, text, labels=["channel"])
        for channel, count in sorted(counts.items()):
            family.add_metric([channel], count)
        yield family
    yield CounterMetricFamily("covrecon_recorded_bytes", "Size of the recording.", statistics.bytes)
    yield GaugeMetricFamily("covrecon_recorder_queue", "Messages that wait for the recorder.", statistics.queue)
    yield GaugeMetricFamily(
        "covrecon_recorder_stall_seconds", "Longest that the recorder held up its caller.", statistics.worst_stall_s
    )
    yield GaugeMetricFamily("covrecon_recorder_failed", "1: the recording has ended early.", bool(statistics.failed))


def _states(name: str, text: str, label: str, known: Sequence[str], current: str) -> Metric:
    family = GaugeMetricFamily(name, text, labels=[label])
    for state in known:
        family.add_metric([state], float(state == current))
    return family
