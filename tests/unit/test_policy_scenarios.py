"""Every row of the policies' table has a flight that shows it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from agents.policies import policy_table

SCENARIOS = (
    Path("tests/scenario/test_px4_failures.py"),
    Path("tests/scenario/test_localization.py"),
    Path("tests/scenario/test_obstacle_flight.py"),
    Path("tests/scenario/test_battery_swap.py"),
)

BATTERIES = "test_batteries_a_gimbal_and_a_pilot"
TELEMETRY = "test_telemetry_an_estimate_a_fence_and_a_refusal"
PROCESSES = "test_an_agent_stopped_one_killed_and_the_ground_station_lost"
OPERATOR = "test_an_operator_pauses_returns_and_lands_drones"
LOST = "test_drones_that_no_longer_know_where_they_are_hold_and_then_land"
STALE = "test_drones_hold_while_no_map_of_free_cells_comes"
SWAP = "test_three_drones_with_batteries_for_a_third_of_the_mission_finish_it_by_swapping"
CUT = "test_the_others_fly_on_and_land_when_a_link_is_cut_for_good"

SHOWN_BY = {
    "take-over": BATTERIES,
    "landing": BATTERIES,
    "telemetry lost": CUT,
    "battery critical": BATTERIES,
    "geofence": TELEMETRY,
    "position lost": LOST,
    "position unsure": LOST,
    "mission end": PROCESSES,
    "battery low": BATTERIES,
    "battery reserve": SWAP,
    "gimbal lost": BATTERIES,
    "ground station lost": PROCESSES,
    "telemetry stale": TELEMETRY,
    "estimate jumped": TELEMETRY,
    "not ours yet": TELEMETRY,
    "obstacle map stale": STALE,
    "operator: land": OPERATOR,
    "operator: return": OPERATOR,
    "operator: pause": OPERATOR,
}


@pytest.fixture
def scenarios(root_path: Path) -> dict[str, str]:
    """Docstrings by the names of the tests."""
    nodes = [node for path in SCENARIOS for node in ast.parse((root_path / path).read_text()).body]
    tests = [
        node
        for node in nodes
        if isinstance(node, ast.AsyncFunctionDef | ast.FunctionDef) and node.name.startswith("test_")
    ]
    return {test.name: ast.get_docstring(test) or "" for test in tests}


def test_every_row_is_shown_by_a_scenario() -> None:
    assert set(SHOWN_BY) == {row[0] for row in policy_table()}


@pytest.mark.parametrize("row", SHOWN_BY)
def test_a_scenario_exists_and_names_its_row(row: str, scenarios: dict[str, str]) -> None:
    assert row in scenarios[SHOWN_BY[row]]
