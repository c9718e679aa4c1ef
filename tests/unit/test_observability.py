"""The samples for Prometheus and Foxglove name only figures, labels, channels and fields that there are."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import foxglove.layouts as players
import promql_parser as promql
import pytest
import yaml
from prometheus_client import CollectorRegistry
from prometheus_client.core import Metric

from agents.agent_metrics import AgentMetrics
from ground_station.ground_metrics import GroundMetrics, MapLoad
from ground_station.recording.channels import _SCHEMAS, CHANNELS
from ground_station.recording.recorder import RecordingStatistics
from ground_station.recording.stored import schema_of
from protocol.guard import ROOT
from protocol.messages import Control, DroneState, DroneStatus, ReplicaState, Status
from protocol.metrics_endpoint import MetricsEndpoint, metrics_port
from protocol.mission_file import load_mission
from protocol.operation_settings import Metrics

FLEET = ROOT / "missions" / "fleet.toml"
SAMPLES = ROOT / "deploy" / "observability"
PROMETHEUS = yaml.safe_load((SAMPLES / "prometheus.yml").read_text())
GROUPS = yaml.safe_load((SAMPLES / "alerts.yml").read_text())["groups"]
RULES: list[dict[str, Any]] = [rule for group in GROUPS for rule in group["rules"]]
LAYOUT: dict[str, Any] = json.loads((SAMPLES / "foxglove-layout.json").read_text())
PROMETHEUS_OWN = {"up": {"job", "instance"}}
"""What Prometheus itself knows of who it asks."""
PANELS = {
    "3D": players.ThreeDeeConfig,
    "Image": players.ImageConfig,
    "Plot": players.PlotConfig,
    "RosOut": players.LogConfig,
    "StateTransitions": players.StateTransitionsConfig,
}
"""Foxglove's settings of each kind of panel."""
TITLE = "foxglovePanelTitle"
ALERTS_WANTED = {
    "StateOld", "SolverFallbacks", "DroneDark", "KeyframesDropped", "RecordsUnwritten", "SeparationLost", "PhiLags",
}  # fmt: skip


# --- prometheus -------------------------------------------------------------------------------------------------------


def told() -> dict[str, set[str]]:
    """Every series that a mission's processes tell, by its name, with its labels."""
    registry = CollectorRegistry()
    replica = ReplicaState(tick=1, epoch=1, next_jump=0, missing=0, repaired=0, lost=0)
    control = Control(
        tick=1, outcome="solved", velocity=(0, 0, 0, 0, 0), slack=0, sampling=0, solve_s=0.001, separation_margin_m2=1,
        region_margin_m=1, pitch_margin_rad2=1, active=(), fallbacks=0, refused=0, telemetry_age_s=0,
    )  # fmt: skip
    state = DroneState(
        drone=1, tick=1, pose=(0, 0, 2, 0, 1), velocity=(0, 0, 0, 0, 0), battery=1, mode="flying", importance=1,
        replica=replica, control=control,
    )  # fmt: skip
    row = DroneStatus(
        drone=1,
        alive=True,
        mode="flying",
        position=(0, 0, 2),
        speed_mps=0,
        separation_m=1,
        slack=0,
        solve_s=0,
        fallbacks=0,
    )
    status = Status(
        phase="flying", activity="", tick=1, time_s=0, importance=1, f_score_visible=0, f_score_objects=0, keyframes=0,
        dropped=0, replica=replica, refused=0, unwritten=0, loop_lag_s=0, keyframes_per_s=0, jumps=0,
        min_separation_m=1, drones=(row,),
    )  # fmt: skip
    AgentMetrics(registry).hear(state)
    ground = GroundMetrics(registry)
    ground.hear_state(state)
    ground.hear_status(
        status,
        MapLoad(),
        recording=RecordingStatistics(
            written={"/a": 1}, dropped={"/a": 1}, bytes=1, worst_stall_s=0, queue=0, failed=""
        ),
    )
    with MetricsEndpoint(load_mission(FLEET).model_copy(update={"metrics": Metrics()}), "agent", 1) as served:
        families: list[Metric] = [*registry.collect(), *served.registry.collect()]
    return {sample.name: set(sample.labels) for family in families for sample in family.samples}


def scraped() -> Iterator[tuple[str, str]]:
    """Address and process of everyone who is asked."""
    for config in PROMETHEUS["scrape_configs"]:
        for group in config["static_configs"]:
            for target in group["targets"]:
                yield target, group["labels"]["process"]


def selectors(node: Any) -> Iterator[promql.VectorSelector]:
    """All of an expression, however deep."""
    if isinstance(node, promql.VectorSelector):
        yield node
    for name in ("lhs", "rhs", "expr", "vector_selector", "param"):
        below = getattr(node, name, None)
        if below is not None:
            yield from selectors(below)
    for argument in getattr(node, "args", None) or ():
        yield from selectors(argument)


def test_prometheus_asks_where_the_fleets_mission_answers() -> None:
    mission = load_mission(FLEET)
    ports = {
        metrics_port(mission, "ground"): "ground",
        metrics_port(mission, "sim"): "sim",
        **{metrics_port(mission, "agent", drone.id): "agent" for drone in mission.drones},
    }

    assert dict(scraped()) == {f"127.0.0.1:{port}": process for port, process in ports.items()}
    assert PROMETHEUS["rule_files"] == ["alerts.yml"]


def test_there_is_an_alert_for_each_of_the_things_that_go_wrong() -> None:
    names = [rule["alert"] for rule in RULES]

    assert len(set(names)) == len(names)
    assert set(names) >= ALERTS_WANTED


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_an_alert_asks_for_what_is_told(rule: dict[str, Any]) -> None:
    known = told() | PROMETHEUS_OWN
    own = {"job", "instance", "process"}  # put on by Prometheus and its configuration
    found = list(selectors(promql.parse(rule["expr"])))

    assert found
    for selector in found:
        assert selector.name in known
        assert {matcher.name for matcher in selector.matchers.matchers} <= known[selector.name] | own
    used = set(re.findall(r"\$labels\.(\w+)", json.dumps(rule["annotations"])))
    assert used <= own.union(*(known[selector.name] for selector in found))
    assert rule["labels"]["severity"] in ("info", "warning", "critical")
    assert set(rule["annotations"]) == {"summary", "action"}
    assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
    assert re.fullmatch(r"\d+s", rule.get("for", "0s"))


def test_an_expression_that_is_none_is_noticed() -> None:
    with pytest.raises(ValueError, match="unclosed"):
        promql.parse("increase(covrecon_keyframes_total[1m]")


def test_every_figure_of_an_expression_is_looked_at() -> None:
    expression = promql.parse(
        "sum by (a) (increase(one[1m])) > 2 * (two + on () group_left () max(-three)) or rate(four[5m:1m]) > 1"
    )
    assert {selector.name for selector in selectors(expression)} == {"one", "two", "three", "four"}


# --- foxglove ---------------------------------------------------------------------------------------------------------


def channels() -> dict[str, type | None]:
    """Every channel of the fleet's recording; what its JSON describes, None for one of Foxglove's own."""
    mission = load_mission(FLEET)
    return {
        name.format(drone=drone.id): _SCHEMAS[name][1] if name in _SCHEMAS else None
        for names in CHANNELS.values()
        for name in names
        for drone in mission.drones
    }


def paths(node: Any) -> Iterator[str]:
    """Every topic, and every field of one, that the layout shows: all that begins with a slash."""
    if isinstance(node, str) and node.startswith("/"):
        yield node
    elif isinstance(node, dict):
        for key, value in node.items():
            yield from paths(key)
            yield from paths(value)
    elif isinstance(node, list):
        for value in node:
            yield from paths(value)


def panels_of(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    else:
        yield from panels_of(node["first"])
        yield from panels_of(node["second"])


def is_there(path: str) -> bool:
    """Whether a recording of the fleet's mission has this topic, and its messages this field."""
    topic, *fields = path.split(".")
    known = channels()
    if topic not in known:
        return False
    if not fields:
        return True
    described = known[topic]
    if described is None:
        return False
    schema = schema_of(described)
    for name in fields:
        schema = schema.get("properties", {}).get(name)
        if schema is None:
            return False
    return True


@pytest.mark.parametrize("path", sorted(set(paths(LAYOUT["configById"]))))
def test_the_layout_shows_what_a_recording_holds(path: str) -> None:
    assert is_there(path)


@pytest.mark.parametrize(
    "path", ["/nowhere", "/drone/9/state", "/drone/1/state.nothing", "/map.field", "/ground/metrics.x.y"]
)
def test_a_path_that_leads_nowhere_is_noticed(path: str) -> None:
    assert not is_there(path)


def test_the_layout_shows_map_importance_log_and_every_drones_picture() -> None:
    shown = set(paths(LAYOUT["configById"]))
    mission = load_mission(FLEET)

    assert {"/map", "/phi", "/log", "/ground/metrics.importance"} <= shown
    assert {f"/drone/{drone.id}/camera" for drone in mission.drones} <= shown


def test_the_layout_places_each_of_its_panels_once() -> None:
    assert sorted(panels_of(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


@pytest.mark.parametrize("panel", LAYOUT["configById"])
def test_foxglove_knows_the_panel_and_its_settings(panel: str) -> None:
    known = PANELS[panel.partition("!")[0]]()._to_dict()

    assert set(LAYOUT["configById"][panel]) <= {*known, TITLE}
