"""Flights in virtual time, replayed: however late and lossy they were, phi and jumps are the same to the last bit."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import cast

import pytest

from faults import virtual_loop
from faults.link import Faults
from faults.recorded_flight import RecordedFlight
from faults.scripted_mapper import ScriptedMapper
from faults.team import flying
from faults.virtual_loop import run
from ground_station.mapper import Mapper
from ground_station.recording.entries import IntegratedTick, JumpRecord
from ground_station.replay.engine import Replay
from protocol.field import VirtualField
from protocol.map_settings import Feedback, Reconstruction
from protocol.mission import Drone, Flight, Mission, Simulation, Target

SEED = 3
DURATION_S = 15.0
END_S = 60.0
"""By then the ground station has ended."""
BAD = Faults(loss=0.1, jitter_s=0.3)
SLOW_S = 2.5
"""What a map update takes: longer than a period, so that jumps come later than they should."""
MISSION = Mission(
    seed=SEED,
    duration_s=DURATION_S,
    target=Target(lower_m=(-2, -2, 0), upper_m=(2, 2, 2), cell_m=0.5, cell_rad=0.6),
    flight=Flight(lower_m=(-2.5, -2.5, 0.5), upper_m=(2.5, 2.5, 1.7)),
    feedback=Feedback(threshold=1.0),
    reconstruction=Reconstruction(backend="none"),
    simulation=Simulation(scene="", start_patience_s=30.0),
    drones=(Drone(id=1, start=(-1, 0, 1.2, 0, 1.3)), Drone(id=4, start=(1, 0, 1.2, 1, 1.3))),
)


def flown(folder: Path, monkeypatch: pytest.MonkeyPatch, faults: Faults, *, lockstep: bool) -> RecordedFlight:
    """What the ground station recorded of a flight whose drones have bad links."""
    flight = RecordedFlight()
    monkeypatch.setattr("faults.team.Recorder", lambda *_, **__: flight)

    async def fly() -> None:
        async with flying(MISSION, folder, SEED, lockstep=lockstep) as team:
            for drone in MISSION.drones:
                team.spoil(f"drone/{drone.id}", faults)
            for role in team.roles:
                team.start(role)
            await asyncio.wait([team.members["ground"].task], timeout=END_S)
            assert not team.failed()

    run(fly())
    return flight


def replayed(flight: RecordedFlight, mission: Mission = MISSION) -> Replay:
    replay = Replay(MISSION, mission, cast("Mapper", mapper(mission)), flight.jumped_looks)
    for entry in flight.inputs:
        replay.feed(entry)
    replay.finish()
    replay.comparison.end(replay.tick, flight.summary, replay.field.sha256, None)
    return replay


def mapper(mission: Mission) -> ScriptedMapper:
    return ScriptedMapper(VirtualField.of(mission.target), SEED)


def delays(flight: RecordedFlight) -> set[int]:
    """Ticks from the look at the map to the jump's effect."""
    return {entry.jump.tick - entry.look for entry in flight.inputs if isinstance(entry, JumpRecord)}


def test_a_flight_in_lockstep_is_the_same_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = flown(tmp_path, monkeypatch, Faults(), lockstep=True)

    replay = replayed(flight)

    assert delays(flight) == {round(MISSION.feedback.delay_s / MISSION.tick_s)}
    assert replay.comparison.jumps == 7
    assert replay.comparison.difference == ""


@pytest.mark.parametrize("slow_s", [virtual_loop.EXECUTOR_S, SLOW_S])
def test_a_late_and_lossy_flight_in_real_time_is_the_same_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow_s: float
) -> None:
    monkeypatch.setattr(virtual_loop, "EXECUTOR_S", slow_s)
    flight = flown(tmp_path, monkeypatch, BAD, lockstep=False)

    replay = replayed(flight)

    team = len(MISSION.drones)
    assert any(len(entry.ids) < team for entry in flight.inputs if isinstance(entry, IntegratedTick)), (
        "nothing was lost"
    )
    assert replay.comparison.jumps >= 4
    assert (max(delays(flight)) > SLOW_S / MISSION.tick_s) == (slow_s == SLOW_S)
    assert replay.comparison.difference == ""
