"""One drone's figures for Prometheus, made from the states that its agent publishes anyway."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from protocol.messages import UNLIMITED, Control, DroneState, Mode

SOLVE_BUCKETS_S = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
"""From a quarter of what a decision takes to two ticks of 20 Hz."""


class AgentMetrics(Collector):
    """`hear` is called by the event loop, `collect` by the thread of a scrape; only immutable messages pass between."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._newest: DroneState | None = None
        self._decisions = Counter(
            "covrecon_agent_decisions",
            "Decisions by what the solver said; after anything but solved the vehicle brakes.",
            ["outcome"],
            registry=registry,
        )
        self._solve = Histogram(
            "covrecon_agent_solve_seconds",
            "Wall time of a decision, quadratic program included.",
            buckets=SOLVE_BUCKETS_S,
            registry=registry,
        )
        registry.register(self)

    def hear(self, state: DroneState) -> None:
        """Take in the agent's own state; a decision counts once, however many states repeat it."""
        control, before = state.control, self._newest
        if control is not None and (before is None or control != before.control):
            self._decisions.labels(control.outcome).inc()
            self._solve.observe(control.solve_s)
        self._newest = state

    def collect(self) -> Iterator[Metric]:
        """Figures of the newest state; none before the first."""
        state = self._newest
        if state is None:
            return
        yield from _of_state(state)
        if state.control is not None:
            yield from _of_control(state.control)


def _of_state(state: DroneState) -> Iterator[Metric]:
    replica = state.replica
    yield GaugeMetricFamily("covrecon_agent_tick", "Newest tick of the mission.", state.tick)
    yield GaugeMetricFamily("covrecon_agent_importance", "J of this drone's phi.", state.importance)
    yield GaugeMetricFamily("covrecon_agent_battery_ratio", "Charge left, 0 to 1.", state.battery)
    yield GaugeMetricFamily("covrecon_agent_blind_seconds", "How long the vehicle has not been heard.", state.blind_s)
    yield GaugeMetricFamily(
        "covrecon_agent_phi_lag_ticks", "Ticks by which phi lags behind.", state.tick - replica.tick
    )
    yield GaugeMetricFamily("covrecon_agent_phi_missing_blocks", "Blocks of phi that are not known.", replica.missing)
    yield CounterMetricFamily("covrecon_agent_phi_repaired_blocks", "Blocks of phi fetched anew.", replica.repaired)
    yield CounterMetricFamily("covrecon_agent_lost_states", "States of others that did not come in time.", replica.lost)
    modes = GaugeMetricFamily("covrecon_agent_mode", "1 for the mode that the drone is in.", labels=["mode"])
    for mode in get_args(Mode):
        modes.add_metric([mode], float(mode == state.mode))
    yield modes


def _of_control(control: Control) -> Iterator[Metric]:
    yield GaugeMetricFamily(
        "covrecon_agent_telemetry_age_seconds", "Age of what was decided by.", control.telemetry_age_s
    )
    yield GaugeMetricFamily(
        "covrecon_agent_slack", "w of the quadratic program; above 0 it falls short.", control.slack
    )
    if control.obstacle_margin_m < UNLIMITED:
        yield GaugeMetricFamily(
            "covrecon_agent_obstacle_margin_meters",
            "Smallest barrier of what was not seen free; negative: too near to it.",
            control.obstacle_margin_m,
        )
    yield CounterMetricFamily(
        "covrecon_agent_refused_messages", "Messages refused, not handled or without room.", control.refused
    )
