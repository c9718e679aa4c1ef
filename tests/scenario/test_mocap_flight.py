"""Flights of drones that motion capture sees, in virtual time and lockstep: repeatable, located, and stopped when it
stops or confuses them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from agents.agent import Agent
from faults.located_team import LocatedTeam, located
from faults.schedule import schedule
from faults.virtual_loop import run
from protocol.geometry import Floats
from protocol.localization_settings import CaptureNoise, EstimateNoise, Localization, Mocap
from protocol.messages import DroneState, ExternalPose
from protocol.mission import Drone, Mission
from sim_bridge.believed import BelievedPoses
from sim_bridge.motion_capture import SimulatedCapture
from sim_bridge.simulator import Simulator

LOST = EstimateNoise(drift_m=1.0, drift_s=5.0, velocity_mps=0.03, white_m=0.02)
"""Of vehicles that hardly know their place themselves."""
STOPS_AT = 60
"""Tick."""
REAL_LOOK = SimulatedCapture.look


def mission(duration_s: float, noise: CaptureNoise | None = None, drones: int = 2, lost_s: float = 2.0) -> Mission:
    base = schedule(0).mission
    team = tuple(Drone(id=k + 1, start=(2.0 * k - 1.0, 1.5 * k - 0.5, 2.0, 0.3, 1.3)) for k in range(drones))
    simulation = base.simulation.model_copy(update={"estimate": LOST, "mocap": noise or CaptureNoise()})
    return base.model_copy(
        update={
            "drones": team,
            "simulation": simulation,
            "localization": Localization(source="mocap", deviation_max_m=0.1, lost_s=lost_s),
            "mocap": Mocap(latency_s=0.05),
            "duration_s": duration_s,
        }
    )


class Flown:
    """What was believed and true in a flight, tick by tick, of all drones."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        self.states: dict[int, list[DroneState]] = {}
        self.errors: list[float] = []
        self.told: list[float] = []
        self.policies: dict[int, list[str]] = {}
        self.down: list[bool] = []
        self.min_separation_m = math.inf
        self.speeds: dict[tuple[int, int], float] = {}
        """True ones, by drone and tick."""

    def note(self, team: LocatedTeam, state: DroneState) -> None:
        self.digest.update(np.array(state.pose).tobytes())
        self.states.setdefault(state.drone, []).append(state)
        self.errors.append(math.dist(team.truth(state)[:3], state.pose[:3]))
        self.told.append(state.position_sd_m)
        simulator = team.members["sim"].shell
        assert isinstance(simulator, Simulator)
        self.speeds[state.drone, state.tick] = float(np.linalg.norm(simulator._bodies[state.drone].velocity[:3]))
        shell = team.members[f"drone/{state.drone}"].shell
        assert isinstance(shell, Agent)
        rows = self.policies.setdefault(state.drone, [])
        if not rows or rows[-1] != shell._orders.newest.policy:
            rows.append(shell._orders.newest.policy)


def fly(flown_mission: Mission, folder: Path) -> Flown:
    flown = Flown()

    async def main() -> None:
        async with located(flown_mission, folder, seed=1) as team:
            hear = BelievedPoses.hear

            def hear_and_note(self: BelievedPoses, state: DroneState) -> None:
                hear(self, state)
                flown.note(team, state)

            with patch.object(BelievedPoses, "hear", hear_and_note):
                await team.until_over()
                simulator = team.members["sim"].shell
                assert isinstance(simulator, Simulator)
                flown.down = [body.is_down for body in simulator._bodies.values()]
            flown.min_separation_m = team.min_separation_m
            assert not team.failed()

    run(main())
    return flown


@contextmanager
def captured(said: object) -> Iterator[None]:
    """With another capture, which says what ``said`` makes of the ticks, the true poses and itself."""
    with patch.object(SimulatedCapture, "look", said):
        yield


def test_a_seen_drone_knows_its_place_through_drop_outs_and_the_same_seed_is_the_same_flight(tmp_path: Path) -> None:
    seen = mission(6.0, CaptureNoise(dropouts_per_min=30.0, dropout_s=0.7))
    first, second = fly(seen, tmp_path / "first"), fly(seen, tmp_path / "second")
    assert first.digest.hexdigest() == second.digest.hexdigest()
    flight = [state for state in first.states[1] if state.tick > 20]
    assert {state.mode for state in flight} & {"flying"}
    errors, told = np.array(first.errors), np.array(first.told)
    sure = told < 0.1
    assert sure.mean() > 0.8, "all but the first half second"
    assert errors[sure].max() < 0.1
    assert np.mean(errors > 3 * told) < 0.03
    assert first.min_separation_m >= seen.flight.separation_m


def test_a_capture_that_stops_has_drones_hold_and_then_land_by_no_stale_pose(tmp_path: Path) -> None:
    def stop(self: SimulatedCapture, tick: int, poses: dict[int, Floats]) -> list[ExternalPose]:
        if tick < STOPS_AT:
            return REAL_LOOK(self, tick, poses)
        return [ExternalPose(drone=drone, tick=tick, age_s=0.0) for drone in poses]

    lost = mission(20.0, drones=1, lost_s=1.0)
    with captured(stop):
        flown = fly(lost, tmp_path)
    for drone, states in flown.states.items():
        rows = flown.policies[drone]
        assert rows.index("position unsure", 1) < rows.index("position lost")
        unsure = next(state.tick for state in states if state.tick > STOPS_AT and state.position_sd_m > 0.1)
        assert 20 < unsure - STOPS_AT < 120, "carried by velocity for seconds, and no longer"
        held = [flown.speeds[drone, tick] for tick in range(unsure + 12, unsure + 20)]
        assert max(held) < 0.1, "it holds, before it lands"
    assert flown.down == [True]
    assert np.mean(np.array(flown.errors) > 3 * np.array(flown.told)) < 0.03


def test_two_confused_bodies_bring_both_drones_down_where_they_are(tmp_path: Path) -> None:
    """Each is told the other's pose, smooth and plausible, for good."""

    def swap(self: SimulatedCapture, tick: int, poses: dict[int, Floats]) -> list[ExternalPose]:
        swapped = {1: poses[2], 2: poses[1]} if tick >= STOPS_AT else poses
        return REAL_LOOK(self, tick, swapped)

    confused = mission(20.0, lost_s=1.0)
    with captured(swap):
        flown = fly(confused, tmp_path)
    assert flown.down == [True, True]
    assert flown.min_separation_m >= confused.flight.separation_m
    beyond = np.array(flown.errors) > 3 * np.array(flown.told)
    assert beyond.mean() < 0.03, "nobody believed to be where the other is"
    for rows in flown.policies.values():
        assert "position lost" in rows


def test_a_body_that_is_lost_for_seconds_is_found_again_and_the_flight_goes_on(tmp_path: Path) -> None:
    def blink(self: SimulatedCapture, tick: int, poses: dict[int, Floats]) -> list[ExternalPose]:
        seen = REAL_LOOK(self, tick, poses)
        if STOPS_AT <= tick < STOPS_AT + 100:
            return [ExternalPose(drone=drone, tick=tick, age_s=0.0) for drone in poses]
        return seen

    with captured(blink):
        flown = fly(mission(13.0, drones=1, lost_s=10.0), tmp_path)
    rows = flown.policies[1]
    assert rows.count("position unsure") == 2, "before the first pose, and after the last"
    assert rows[rows.index("position unsure", 1) + 1] == "as planned"
    assert flown.errors[-50] == pytest.approx(0.0, abs=0.03)
