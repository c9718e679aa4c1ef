"""Batteries of PX4-like vehicles that are changed in a mission, with the power on and with the power off."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from deploy.command_client import Place, command
from faults.judgement import kept_keyframes
from faults.px4_flight import HOME_M, PATIENCE_S, FlownDrone, Px4Flight, px4_flight, px4_mission
from protocol.mission import Mission
from protocol.session import Link
from protocol.verbs import Verb
from sim_bridge.px4_endpoint.endpoint import Endpoint

pytestmark = [pytest.mark.processes, pytest.mark.timeout(300)]

OFF_S = 4.0
ELSEWHERE_M = 2.0


@pytest.fixture(autouse=True)
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests of this machine fly the same system ids."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))


def swapping_mission(folder: Path) -> Mission:
    """Batteries for 24 seconds, which the crew changes in two seconds."""
    mission = px4_mission(folder, 3)
    vehicles = mission.vehicles.model_copy(
        update={"battery_swap_s": 2.0, "battery_full_s": 24.0, "battery_low": 0.2, "reserve_factor": 1.2}
    )
    autopilot = mission.autopilot.model_copy(update={"battery_s": 24.0, "power_off_s": OFF_S})
    return mission.model_copy(update={"vehicles": vehicles, "autopilot": autopilot, "stop_below": 0.2})


async def test_a_mission_whose_batteries_are_changed_with_the_power_on_and_off(tmp_path: Path) -> None:
    """Three vehicles: the first is fed while its battery is changed, the others lose their power, and the last one
    takes itself to be elsewhere afterwards."""
    mission = swapping_mission(tmp_path)
    fed_id, off_id, lost_id = (drone.id for drone in mission.drones)

    def crew(autopilots: Endpoint) -> None:
        autopilots.vehicles[fed_id].power_off_s = 0.0
        autopilots.vehicles[lost_id].wake_elsewhere((ELSEWHERE_M, 0.0, 0.0))

    async with px4_flight(mission, tmp_path, crew) as flight:
        async with asyncio.TaskGroup() as drones:
            drones.create_task(it_flies_on(flight, flight.drones[fed_id], boots=0))
            drones.create_task(it_flies_on(flight, flight.drones[off_id], boots=1))
            drones.create_task(it_stays(flight, flight.drones[lost_id]))
        await flight.until(flight.processes.monitor.is_healed, "all to know all of phi")
        await ordered(flight, "land", [*flight.drones])
        await flight.until(lambda: flight.processes.code("ground") is not None, "the mission to end", 60.0)
        for drone in flight.drones.values():
            await drone.until_down()
        flight.judge({})
        summary = json.loads((flight.processes.run / "summary.json").read_bytes())
        assert summary["exit_reason"] == "all drones have landed"
        assert summary["J"] < 0.5
        assert kept_keyframes(flight.processes.run) == summary["keyframes"] > 0
        assert flight.drones[lost_id].vehicle.aircraft.boots == 1


async def ordered(flight: Px4Flight, verb: Verb, drones: list[int]) -> None:
    place = Place(Link(flight.processes.endpoint), flight.processes.mission.name)
    await command(place, verb, drones, say=lambda _: None, patience_s=PATIENCE_S)


async def it_comes_down(drone: FlownDrone) -> None:
    await drone.until_said(r"return: battery reserve \(battery at \d+%, the way home is kept \d+%\)")
    await drone.until_said(r"on the ground at \d+%: waits for another battery")
    assert drone.is_down
    assert drone.home_m < HOME_M
    await drone.until(lambda: drone.mode == "starting", "to say that it is not landed for good")


async def it_flies_on(flight: Px4Flight, drone: FlownDrone, *, boots: int) -> None:
    await it_comes_down(drone)
    landed = len(drone.log)
    await drone.until_said("another battery is in, at 100%")
    assert drone.vehicle.aircraft.boots == boots
    assert drone.said("silent on the ground: is checked again", after=landed) == (boots > 0)
    assert not drone.said("no sound telemetry", after=landed), "who stands on the ground is known to, though silent"
    marked = len(drone.log)
    assert drone.is_down, "until somebody says that hands are off"
    await ordered(flight, "resume", [drone.id])
    await drone.until_said("preflight, on the ground: .*: all fine", after=landed)
    await drone.until_said("fly: as planned", after=marked)
    await drone.until_it_moves_on()


async def it_stays(flight: Px4Flight, drone: FlownDrone) -> None:
    """And the others keep clear of where it truly is."""
    await it_comes_down(drone)
    await drone.until_said(r"its estimate moved by 2\.\d m on the ground: stays there")
    await ordered(flight, "resume", [drone.id])
    states = flight.processes.monitor.states
    await drone.until(lambda: abs(states[drone.id].pose[0] - drone.position[0]) < HOME_M, "to stand where it stands")
    assert not drone.said("another battery is in")
