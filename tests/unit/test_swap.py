"""When a landed drone has another battery, and when its way up is free."""

from __future__ import annotations

import numpy as np
import pytest

from agents.barriers import Neighbour
from agents.policies import Order
from agents.swap import ENERGY, PATIENCE_S, RISE, SPARE_M, Swap
from agents.team import Team
from agents.vehicles.vehicle import Telemetry
from protocol.battery_settings import Battery
from protocol.messages import DroneOrder
from protocol.mission import Drone, Mission, Simulation
from protocol.separation import widened_separation
from protocol.team_states import Sighting
from protocol.vehicle_settings import Vehicles

START = (1.0, 2.0, 2.0, 0.0, 1.3)
LOW = 0.2


def mission(**vehicles: object) -> Mission:
    settings = Vehicles.model_validate({"battery_swap_s": 10.0, "battery_low": LOW, **vehicles})
    drones = (Drone(id=1, start=START), Drone(id=2, start=(-2.0, 0.0, 2.0, 0.0, 1.3)))
    return Mission(drones=drones, vehicles=settings, simulation=Simulation(battery=Battery(capacity_wh=20.0)))


MISSION = mission()
ROOM_M = widened_separation(MISSION.flight)


def fly(number: int = 0, action: str = "fly") -> DroneOrder:
    return DroneOrder.model_validate({"drone": 1, "action": action, "number": number})


def telemetry(share: float, stamp_s: float = 0.0, x_m: float = START[0], z_m: float = 0.0) -> Telemetry:
    return Telemetry(np.array([x_m, START[1], z_m, 0.0, 1.3]), np.zeros(5), share, stamp_s)


def swap_of(mission: Mission = MISSION, cause: str = "battery reserve") -> tuple[Swap, list[str]]:
    said: list[str] = []
    swap = Swap(mission, 1, lambda level, kind, text: said.append(f"{level} {kind}: {text}"))
    swap.note(Order("return", cause), stays=False)
    swap.note(Order("land", "landing"), stays=False)
    return swap, said


@pytest.mark.parametrize("cause", ENERGY)
def test_who_came_down_for_its_battery_waits_for_another_and_then_flies_on(cause: str) -> None:
    swap, said = swap_of(cause=cause)
    assert swap.is_awaited
    assert not swap.is_done(telemetry(0.3), "landing", fly())
    assert not swap.is_done(telemetry(0.3), "landed", fly())
    assert not swap.is_done(telemetry(0.3 + RISE - 0.01), "landed", fly()), "batteries recover a little"
    assert swap.is_done(telemetry(1.0), "landed", fly())
    assert said == [
        "info battery: on the ground at 30%: waits for another battery",
        "info battery: another battery is in, at 100%",
    ]
    swap.renew(5.0)
    assert swap.count == 1
    assert not swap.is_awaited


@pytest.mark.parametrize("cause", ["operator: land", "operator: return", "mission end", "gimbal lost", "position lost"])
def test_who_came_down_for_another_reason_stays(cause: str) -> None:
    swap, _ = swap_of(cause=cause)
    assert not swap.is_awaited
    assert not swap.is_done(telemetry(1.0), "landed", fly())


def test_without_the_setting_nobody_flies_on() -> None:
    swap, said = swap_of(mission(battery_swap_s=0.0))
    assert not swap.is_awaited
    assert not said


def test_after_the_mission_nobody_waits_for_a_battery() -> None:
    swap, _ = swap_of()
    swap.note(Order("land", "landing"), stays=True)
    assert not swap.is_awaited


def test_who_has_used_up_its_spares_stays() -> None:
    swap, _ = swap_of(mission(battery_spares=1))
    assert swap.is_done(telemetry(0.3), "landed", fly()) is False
    assert swap.is_done(telemetry(1.0), "landed", fly())
    swap.renew(0.0)
    swap.note(Order("return", "battery low"), stays=False)
    assert not swap.is_awaited


def test_a_battery_that_is_not_full_enough_is_none() -> None:
    swap, _ = swap_of()
    assert not swap.is_done(telemetry(0.05), "landed", fly())
    assert not swap.is_done(telemetry(LOW), "landed", fly())
    assert swap.is_done(telemetry(LOW + 0.01), "landed", fly())


def test_a_real_drone_waits_for_its_crew_to_say_so() -> None:
    swap, _ = swap_of(mission(kind="px4"))
    assert not swap.is_done(telemetry(0.3), "landed", fly(4)), "whatever was ordered before the landing"
    assert not swap.is_done(telemetry(1.0), "landed", fly(4))
    assert not swap.is_done(telemetry(1.0), "landed", fly(5, "hold"))
    assert swap.is_done(telemetry(1.0), "landed", fly(6))


def test_a_real_drone_flies_on_by_itself_where_the_mission_says_so() -> None:
    swap, _ = swap_of(mission(kind="px4", swapped="at_once"))
    assert not swap.is_done(telemetry(0.3), "landed", fly())
    assert swap.is_done(telemetry(1.0), "landed", fly())


def test_who_thinks_to_have_moved_on_the_ground_stays_there() -> None:
    swap, said = swap_of()
    assert not swap.is_done(telemetry(0.3), "landed", fly())
    for _ in range(3):
        assert not swap.is_done(telemetry(1.0, x_m=START[0] + 0.6), "landed", fly())
    assert said[-1] == "error battery: its estimate moved by 0.6 m on the ground: stays there"
    assert len(said) == 2


def test_to_the_others_who_no_longer_knows_its_place_stands_where_it_landed() -> None:
    swap, said = swap_of()
    assert not swap.is_done(telemetry(0.3), "landed", fly())
    elsewhere = telemetry(0.3, x_m=START[0] + 2.0)
    assert not swap.is_done(elsewhere, "landed", fly())
    assert said[-1] == "error battery: its estimate moved by 2.0 m on the ground: stays there", "whatever its battery"
    assert swap.as_it_stands(elsewhere).pose[0] == START[0]
    back = telemetry(1.0, x_m=START[0] + 0.1)
    assert swap.is_done(back, "landed", fly())
    assert swap.as_it_stands(back) is back


def neighbour(*place: float, age_s: float = 0.0) -> Neighbour:
    return Neighbour(2, np.array(place), age_s)


def ready() -> Swap:
    swap, _ = swap_of()
    swap.renew(0.0)
    return swap


def beside(room_m: float, z_m: float) -> Neighbour:
    """So much farther away from the way up than it must be."""
    return neighbour(START[0] + ROOM_M + room_m, START[1], z_m)


@pytest.mark.parametrize("z_m", [0.0, 1.0, 2.0])
def test_it_says_that_it_will_climb_when_nobody_is_near_and_climbs_a_tick_later(z_m: float) -> None:
    swap, away = ready(), [beside(SPARE_M + 0.01, z_m)]
    assert swap.climb_m(telemetry(1.0), "ready") == 0.0
    assert not swap.may_climb(telemetry(1.0), away)
    assert swap.climb_m(telemetry(1.0), "ready") == 2.0
    assert swap.may_climb(telemetry(1.0), away)
    assert swap.climb_m(telemetry(1.0, z_m=0.5), "starting") == 1.5
    assert swap.climb_m(telemetry(1.0, z_m=1.95), "ours") == 0.0
    assert not swap.climbs


def test_it_waits_while_somebody_is_near_its_way_up_but_not_for_ever() -> None:
    swap, near = ready(), [beside(SPARE_M - 0.01, 1.5)]
    assert not swap.may_climb(telemetry(1.0, PATIENCE_S), near)
    assert not swap.climbs
    assert not swap.may_climb(telemetry(1.0, PATIENCE_S + 0.1), near)
    assert swap.climbs, "now the others have to go"
    assert not swap.may_climb(telemetry(1.0, PATIENCE_S + 5.0), [beside(-0.01, 1.5)])
    assert swap.may_climb(telemetry(1.0, PATIENCE_S + 5.0), [beside(0.001, 1.5)])


def test_a_silent_one_may_be_anywhere_near() -> None:
    swap, far = ready(), neighbour(START[0] + ROOM_M + 1.0, START[1], 1.0, age_s=2.0)
    assert not swap.may_climb(telemetry(1.0), [far])
    assert not swap.climbs


@pytest.mark.parametrize(("own_m", "seen_m"), [(0.2, 0.3), (1.0, 1.0), (1.9, 1.8), (4.0, 1.8)])
def test_to_the_others_it_is_everywhere_on_its_way_up(own_m: float, seen_m: float) -> None:
    starts = {1: START, 2: (-2.0, 0.0, 2.0, 0.0, 1.3)}
    team = Team(1, starts, MISSION.flight, MISSION.tick_s)
    pose = (-2.0, 0.0, 0.3, 0.0, 1.3)
    team.hear(Sighting(2, 5, pose, (0.0,) * 5, 0.0, False, (), climb_m=1.5), 5)
    (seen,) = team.neighbours(5, height_m=own_m)
    assert seen.position.tolist() == pytest.approx([-2.0, 0.0, seen_m])
    team.hear(Sighting(2, 6, pose, (0.0,) * 5, 0.0, False, ()), 6)
    (seen,) = team.neighbours(6, height_m=own_m)
    assert seen.position[2] == pytest.approx(0.3), "where it is, once it gives way"
