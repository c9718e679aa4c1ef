"""Every failure that the policies know, put into PX4-like vehicles in flight, and what came of it."""

from __future__ import annotations

import asyncio
import json
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from deploy.command_client import Place, command
from faults.px4_flight import HOME_M, PATIENCE_S, FlownDrone, px4_flight, px4_mission
from protocol.errors import CommandError
from protocol.session import Link
from protocol.verbs import Verb
from sim_bridge.px4_endpoint.endpoint import Endpoint

pytestmark = [pytest.mark.processes, pytest.mark.timeout(300)]


@pytest.fixture(autouse=True)
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests of this machine fly the same system ids."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))


# --- batteries, a gimbal and a pilot ----------------------------------------------------------------------------------


async def test_batteries_a_gimbal_and_a_pilot(tmp_path: Path) -> None:
    """battery low, battery critical, gimbal lost, take-over, landing."""
    async with px4_flight(px4_mission(tmp_path, 4), tmp_path) as flight:
        low, critical, gimbal, pilot = flight.drones.values()
        async with asyncio.TaskGroup() as failures:
            failures.create_task(a_low_battery_brings_it_home(low))
            failures.create_task(a_critical_battery_brings_it_down_where_it_is(critical))
            failures.create_task(a_stuck_gimbal_brings_it_home(gimbal))
            failures.create_task(a_pilot_takes_over_and_gives_back(pilot))
        flight.judge({})


async def a_low_battery_brings_it_home(low: FlownDrone) -> None:
    await low.until(lambda: low.home_m > 0.5, "to leave its start")
    low.vehicle.set_battery(0.2)
    await low.until_said(r"return: battery low \(battery at 20%\)")
    await low.until_down()
    assert low.home_m < HOME_M


async def a_critical_battery_brings_it_down_where_it_is(critical: FlownDrone) -> None:
    await critical.until(lambda: critical.home_m > 0.5, "to leave its start")
    critical.vehicle.set_battery(0.05)
    place = critical.position
    await critical.until_said(r"land: battery critical \(battery at 5%\)")
    await critical.until_down()
    assert np.linalg.norm((critical.position - place)[:2]) < GIVEN_WAY_M


async def a_stuck_gimbal_brings_it_home(gimbal: FlownDrone) -> None:
    await gimbal.until_it_moves_on()
    gimbal.vehicle.gimbal_stuck = True
    await gimbal.until_said(r"return: gimbal lost \(the gimbal does not obey\)")
    assert gimbal.said("degrees from where it is told to point")
    await gimbal.until_down()
    assert gimbal.home_m < HOME_M


async def a_pilot_takes_over_and_gives_back(pilot: FlownDrone) -> None:
    await pilot.until_it_moves_on()
    away = np.sign(pilot.position) * (0.25, 0.25, 0.0)
    pilot.vehicle.pilot("POSCTL", tuple(away))
    await pilot.until_said(r"yield: take-over \(a pilot switched to POSCTL\)")
    yielded_s, place, marked = time.monotonic(), pilot.position, len(pilot.log)
    await pilot.until(lambda: float((pilot.position - place) @ away) > 0.15, "to fly as the sticks say")
    assert pilot.vehicle.mode.name == "POSCTL"
    assert not any(speed for at_s, speed in list(pilot.setpoints) if at_s > yielded_s), "zeros for a hand-over only"
    pilot.vehicle.pilot("OFFBOARD")
    await pilot.until_said(r"fly: as planned", after=marked)
    await pilot.until_it_moves_on()


# --- telemetry, estimates, a fence and a refusal ----------------------------------------------------------------------

SILENCE_S = 1.5
GIVEN_WAY_M = 1.5
"""How far from where it began to land a drone may come down: on the way it keeps its distance to those that fly on."""
JUMP_M = 0.8
PUSH_MPS = 1.5
PUSHED_M = 1.5
"""Outside the region: the fence's margin, and what a second of pushing adds."""


async def test_telemetry_an_estimate_a_fence_and_a_refusal(tmp_path: Path) -> None:
    """telemetry stale, estimate jumped, geofence, not ours yet, mission end."""
    mission = px4_mission(tmp_path, 4, takeoff_s=8.0)
    refusing_id = mission.drones[3].id

    def refuse_offboard(autopilots: Endpoint) -> None:
        autopilots.vehicles[refusing_id].refuse_offboard = True

    async with px4_flight(mission, tmp_path, refuse_offboard) as flight:
        silent, jumping, pushed, refusing = flight.drones.values()
        async with asyncio.TaskGroup() as failures:
            failures.create_task(a_short_silence_stops_it(silent))
            failures.create_task(an_estimate_that_jumps_holds_it(jumping))
            failures.create_task(outside_the_fence_it_lands(pushed))
            failures.create_task(one_that_refuses_offboard_says_so(refusing))
        assert refusing.vehicle.mode.name == "HOLD"
        assert not refusing.said("fly:")
        flight.call_off("enough seen")
        for drone in (silent, jumping, refusing):
            await drone.until_said(r"(return|wait|land): mission end \(enough seen\)")
            await drone.until_down()
        assert silent.home_m < HOME_M
        assert jumping.home_m < HOME_M + JUMP_M
        assert refusing.home_m < HOME_M
        flight.judge({jumping.id: mission.vehicles.fence_margin_m + JUMP_M, pushed.id: PUSHED_M}, {jumping.id: JUMP_M})


async def a_short_silence_stops_it(silent: FlownDrone) -> None:
    """Shorter than ``vehicles.telemetry_lost_s``."""
    await silent.until_on_its_way()
    silent.vehicle.silent, began_s = True, time.monotonic()
    await silent.until_said(r"hold: telemetry stale \(telemetry 0\.\d s old\)")
    await silent.until(lambda: silent.speed < 0.05 and time.monotonic() - began_s > SILENCE_S, "to stop")
    assert silent.is_ours
    marked = len(silent.log)
    silent.vehicle.silent = False
    await silent.until_said("fly: as planned", after=marked)
    await silent.until_it_moves_on()


async def an_estimate_that_jumps_holds_it(jumping: FlownDrone) -> None:
    """Inwards, so that it is truly further from the others than it and they believe."""
    await jumping.until_it_moves_on()
    inwards = -np.sign(jumping.position[:2]) * JUMP_M / np.sqrt(2)
    jumping.vehicle.jump((*inwards.tolist(), 0.0))
    await jumping.until_said(r"hold: estimate jumped \(the position estimate jumped\)")
    marked = len(jumping.log)
    await jumping.until_said("fly: as planned", after=marked)
    await jumping.until_it_moves_on()


async def outside_the_fence_it_lands(pushed: FlownDrone) -> None:
    await pushed.until_it_moves_on()
    pushed.vehicle.push((0.0, PUSH_MPS * float(np.sign(pushed.position[1])), 0.0), PATIENCE_S)
    await pushed.until_said(r"land: geofence \(0\.\d+ m outside the flight region\)")
    pushed.vehicle.push((0.0, 0.0, 0.0), 0.0)
    await pushed.until_down()


async def one_that_refuses_offboard_says_so(refusing: FlownDrone) -> None:
    await refusing.until_said("Switching to Offboard is currently not available")
    assert refusing.said(r"wait: not ours yet \(")
    await refusing.until(lambda: refusing.vehicle.mode.name == "HOLD", "to hold after its take-off")


# --- an operator ------------------------------------------------------------------------------------------------------


async def test_an_operator_pauses_returns_and_lands_drones(tmp_path: Path) -> None:
    """operator: pause, operator: return, operator: land; and a ground station that is killed in between."""
    async with px4_flight(px4_mission(tmp_path, 3), tmp_path) as flight:
        returning, landing, other = flight.drones.values()
        place = Place(Link(flight.processes.endpoint), flight.processes.mission.name)

        async def order(verb: Verb, *drones: FlownDrone) -> None:
            await command(place, verb, [drone.id for drone in drones], say=lambda _: None, patience_s=PATIENCE_S)

        for drone in flight.drones.values():
            await drone.until_on_its_way()
        await order("pause")
        for drone in flight.drones.values():
            await drone.until_said(r"hold: operator: pause \(commanded\)")
            await drone.until(lambda drone=drone: drone.is_ours and drone.speed < 0.1, "to hold")  # type: ignore[misc]
        marked = {drone.id: len(drone.log) for drone in flight.drones.values()}
        await order("resume")
        for drone in flight.drones.values():
            await drone.until_said("fly: as planned", after=marked[drone.id])
        await order("return", returning)
        await order("land", landing)
        await flight.processes.kill("ground")
        flight.processes.start("ground")
        await other.until_it_moves_on()
        with pytest.raises(CommandError, match=f"nothing to pause: drone {landing.id} lands already"):
            await order("pause", landing)
        await landing.until_said(r"land: operator: land \(commanded\)")
        await landing.until_down()
        await returning.until_said(r"return: operator: return \(commanded\)")
        await returning.until_down()
        assert returning.home_m < HOME_M
        await order("abort")
        await other.until_down()
        await flight.until(lambda: flight.processes.code("ground") == 0, "the ground station to end")
        summary = json.loads((flight.processes.run / "summary.json").read_bytes())
        assert summary["exit_reason"] == "aborted by an operator"
        flight.judge({})


# --- processes and links ----------------------------------------------------------------------------------------------

STOPPED_S = 5.0
FAILSAFE_S = 1.5
"""COM_OF_LOSS_T is a second; MAVSDK's last setpoint and a step of the vehicle come on top."""
GROUND_PATIENCE_S = 4.0
CUT_S = 5.0
"""Long enough for whoever would keep away from a silent drone, wherever it may have gone, to find no way any more."""


async def test_an_agent_stopped_one_killed_and_the_ground_station_lost(tmp_path: Path) -> None:
    """ground station lost, mission end; and agents that are stopped and killed."""
    async with px4_flight(px4_mission(tmp_path, 3, ground_patience_s=GROUND_PATIENCE_S), tmp_path) as flight:
        stopped, killed, other = flight.drones.values()
        async with asyncio.TaskGroup() as failures:
            failures.create_task(a_stopped_agent_goes_on_where_it_was(stopped))
            failures.create_task(a_killed_agent_is_replaced_in_the_air(killed))
        await flight.processes.kill("ground")
        async with asyncio.TaskGroup() as failures:
            for drone in (stopped, killed, other):
                failures.create_task(without_a_ground_station_it_holds(drone))
        marked = {drone.id: len(drone.log) for drone in flight.drones.values()}
        flight.processes.start("ground")
        for drone in (stopped, killed, other):
            await drone.until_said("fly: as planned", after=marked[drone.id])
        flight.call_off("enough seen")
        for drone in (stopped, killed, other):
            await drone.until_said(r"return: mission end \(enough seen\)")
            await drone.until_down()
            assert drone.home_m < HOME_M
        flight.judge({})


async def a_stopped_agent_goes_on_where_it_was(stopped: FlownDrone) -> None:
    await stopped.until_on_its_way()
    stopped.flight.processes.signal(stopped.name, signal.SIGSTOP)
    began_s = time.monotonic()
    await the_failsafe_holds(stopped)
    await stopped.until(lambda: time.monotonic() - began_s > STOPPED_S, "to have been stopped")
    assert stopped.vehicle.mode.name == "HOLD"
    marked = len(stopped.log)
    stopped.flight.processes.signal(stopped.name, signal.SIGCONT)
    await stopped.until(lambda: stopped.is_ours, "to enter OFFBOARD again")
    await stopped.until_it_moves_on()
    assert not stopped.said("yield", after=marked)


async def a_killed_agent_is_replaced_in_the_air(killed: FlownDrone) -> None:
    await killed.until_on_its_way()
    await killed.flight.processes.kill(killed.name)
    await the_failsafe_holds(killed)
    height_m, marked = killed.position[2], len(killed.log)
    killed.flight.processes.start(killed.name)
    await killed.until_said("preflight, in the air", after=marked)
    await killed.until_said("fly: as planned", after=marked)
    assert killed.position[2] == pytest.approx(height_m, abs=0.3)
    await killed.until_it_moves_on()


async def the_failsafe_holds(drone: FlownDrone) -> None:
    """PX4's own, without anybody's help."""
    silent_s = await drone.until(lambda: drone.vehicle.mode.name == "HOLD", "to fall into HOLD")
    assert silent_s < FAILSAFE_S
    await drone.until(lambda: drone.speed < 0.1, "to stop")


async def without_a_ground_station_it_holds(drone: FlownDrone) -> None:
    await drone.until_said(rf"hold: ground station lost \(no ground station for {GROUND_PATIENCE_S:.0f} s\)")
    await drone.until(lambda: drone.is_ours and drone.speed < 0.1, "to hold")


async def test_the_others_fly_on_and_land_when_a_link_is_cut_for_good(tmp_path: Path) -> None:
    """telemetry lost."""
    async with px4_flight(px4_mission(tmp_path, 3), tmp_path) as flight:
        cut, one, other = flight.drones.values()
        for drone in (cut, one, other):
            await drone.until_on_its_way()
        cut.vehicle.cut, began_s = True, time.monotonic()
        await the_failsafe_holds(cut)
        await cut.until_said(r"land: telemetry lost \(telemetry [\d.]+ s old\)")
        async with asyncio.TaskGroup() as others:
            others.create_task(it_flies_on(one, began_s + CUT_S))
            others.create_task(it_flies_on(other, began_s + CUT_S))
        flight.call_off("enough seen")
        for drone in (one, other):
            await drone.until_said(r"return: mission end \(enough seen\)")
            await drone.until_down()
        assert cut.vehicle.mode.name == "HOLD", "nobody can tell it to come down"
        assert cut.speed < 0.1
        flight.judge({})


async def it_flies_on(drone: FlownDrone, after_s: float) -> None:
    """Not braking, at a time when it would be if the silent one could be anywhere."""
    await drone.until(lambda: time.monotonic() > after_s and drone.mode == "flying", "to fly on")
    await drone.until_it_moves_on()
