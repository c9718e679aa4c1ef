"""The battery's reserve for the way home: from the real way, and from the use that was measured."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents.energy import LAST_METRES_S, LEARN_S, WINDOW_S, Reserve, landing_s
from agents.obstacles import Obstacles
from agents.vehicles.vehicle import Telemetry
from faults.zones import PILLAR
from protocol.battery_settings import Battery
from protocol.mission import Drone, Flight, Mission, Simulation
from protocol.obstacle_settings import Obstacles as ObstacleSettings
from protocol.vehicle_settings import Vehicles

HOME = (0.0, 0.0, 2.0, 0.0, 1.3)
VEHICLES = Vehicles(battery_critical=0.1, battery_low=0.2, reserve_factor=1.5, battery_full_s=1000.0)
FLIGHT = Flight(lower_m=(-4.0, -4.0, 0.5), speed_max_mps=0.5)


def mission(flight: Flight = FLIGHT, vehicles: Vehicles = VEHICLES, home: tuple[float, ...] = HOME) -> Mission:
    drones = (
        Drone(id=3, start=home),
        Drone(id=5, start=(-3.0, -3.0, 2.0, 0.0, 1.3)),
        Drone(id=7, start=(3.0, 3.0, 2.0, 0.0, 1.3)),
    )
    return Mission(
        flight=flight, vehicles=vehicles, drones=drones, simulation=Simulation(battery=Battery(capacity_wh=20.0))
    )


def telemetry(share: float, stamp_s: float, place: tuple[float, float, float] = (0.0, 0.0, 2.0)) -> Telemetry:
    return Telemetry(np.array([*place, 0.0, 1.3]), np.zeros(5), share, stamp_s)


def learned(reserve: Reserve, use_per_s: float, seconds: float = 60.0, *, share: float = 0.9) -> Reserve:
    """After a flight at home with this use."""
    for k in range(round(seconds * 20) + 1):
        reserve.look(telemetry(share - use_per_s * k / 20, k / 20))
    return reserve


def test_a_full_battery_needs_no_reserve() -> None:
    reserve = Reserve(mission(), 3)
    reserve.look(telemetry(1.0, 0.0))
    assert reserve.share == 0.0


def test_the_use_is_the_fall_of_the_share_over_time_and_no_less_than_the_longest_flight_says() -> None:
    assert learned(Reserve(mission(), 3), 0.004).use_per_s == pytest.approx(0.004)
    assert learned(Reserve(mission(), 3), 0.0).use_per_s == 1 / 1000


def test_nothing_is_learned_from_a_moment() -> None:
    assert learned(Reserve(mission(), 3), 0.02, LEARN_S - 1).use_per_s == 1 / 1000
    assert learned(Reserve(mission(), 3), 0.02, LEARN_S + 1).use_per_s == pytest.approx(0.02)


def test_with_another_battery_the_use_is_that_of_the_one_before_until_it_is_learned_anew() -> None:
    reserve = learned(Reserve(mission(), 3), 0.02, 30.0)
    reserve.land()
    assert reserve.use_per_s == pytest.approx(0.02)
    assert learned(reserve, 0.005, LEARN_S - 1).use_per_s == pytest.approx(0.02)
    assert learned(reserve, 0.005, LEARN_S + 1).use_per_s == pytest.approx(0.005)


def test_the_use_follows_what_is_flown_now() -> None:
    reserve = learned(Reserve(mission(), 3), 0.001, 100.0)
    for k in range(round(WINDOW_S * 20) + 20):
        reserve.look(telemetry(0.8 - 0.005 * k / 20, 100 + k / 20))
    assert reserve.use_per_s == pytest.approx(0.005)


def test_whole_per_cents_of_px4_are_good_enough() -> None:
    reserve = Reserve(mission(), 3)
    for k in range(1200):
        reserve.look(telemetry(math.ceil(100 * (0.9 - k / 20 / 400)) / 100, k / 20))
    assert reserve.use_per_s == pytest.approx(1 / 400, rel=0.1)


def test_the_reserve_is_the_way_home_and_the_landing_times_its_factor_above_critical() -> None:
    reserve = learned(Reserve(mission(), 3), 0.004)
    reserve.look(telemetry(0.6, 61.0, (3.0, 0.0, 2.0)))
    use = reserve.use_per_s
    assert reserve.home_s == pytest.approx(3.0 / 0.5 + 2.0 / 0.3 + LAST_METRES_S)
    assert reserve.share == pytest.approx(0.1 + 1.5 * reserve.home_s * use)


def test_the_way_home_goes_around_zones() -> None:
    """Behind a pillar from floor to ceiling; straight through it would be shorter."""
    zones = FLIGHT.model_copy(update={"no_fly": Flight(no_fly=(PILLAR,)).no_fly})
    home, place = (1.0, -3.5, 2.0, 0.0, 1.3), (1.0, -0.5, 2.0)
    free, around = (Reserve(mission(flight, home=home), 3) for flight in (FLIGHT, zones))
    for reserve in (free, around):
        learned(reserve, 0.004)
        reserve.look(telemetry(0.6, 61.0, place))
    assert free.home_s == pytest.approx(3.0 / 0.5 + landing_s(FLIGHT, 2.0))
    assert around.home_s > free.home_s + 0.5


def test_among_obstacles_the_way_home_leads_over_them() -> None:
    among = FLIGHT.model_copy(update={"obstacles": ObstacleSettings(enabled=True, clear_above_m=2.0)})
    obstacles = Obstacles(mission(among))
    low, above, at_home = (3.0, 0.0, 1.0), (3.0, 0.0, 3.0), (0.0, 0.0, 1.0)
    times = []
    for heeded in (None, obstacles):
        reserve = learned(Reserve(mission(among), 3, heeded), 0.004)
        for k, place in enumerate((low, above, at_home)):
            reserve.look(telemetry(0.6, 61.0 + k, place))
            times.append(reserve.home_s)
    climb_m = obstacles.clear_m - 1.0
    assert climb_m > 1.0
    assert times[3] == pytest.approx(times[0] + climb_m / 0.5 + climb_m / 0.3)
    assert times[4:] == times[1:3], "above them, and at home, nothing is to be climbed"


def test_without_swaps_everybody_keeps_the_same_reserve() -> None:
    shares = {drone: learned(Reserve(mission(), drone), 0.004).home_s for drone in (3, 5, 7)}
    assert shares[5] == shares[7], "both are as far from home"
    at_home = [learned(Reserve(mission(), drone), 0.004).share for drone in (5, 7)]
    assert at_home[0] == at_home[1]


def test_drones_that_swap_go_home_one_after_another_with_their_first_battery_alone() -> None:
    swaps = VEHICLES.model_copy(update={"battery_swap_s": 20.0})
    reserves = [Reserve(mission(vehicles=swaps), drone) for drone in (3, 5, 7)]
    for reserve in reserves:
        learned(reserve, 0.002)
    away = [(20.0 + 2 * reserve.home_s) * reserve.use_per_s for reserve in reserves]
    plain = [0.1 + 1.5 * reserve.home_s * reserve.use_per_s for reserve in reserves]
    for rank, reserve in enumerate(reserves):
        assert reserve.share == pytest.approx(plain[rank] + rank * away[rank])
    for rank, reserve in enumerate(reserves):
        reserve.land()
        assert reserve.share == 0.0
        learned(reserve, 0.002)
        assert reserve.share == pytest.approx(plain[rank])


def test_a_small_first_battery_is_shared_out_evenly() -> None:
    swaps = VEHICLES.model_copy(update={"battery_swap_s": 60.0})
    reserve = learned(Reserve(mission(vehicles=swaps), 7), 0.014, 30.0)
    plain = 0.1 + 1.5 * reserve.home_s * reserve.use_per_s
    assert reserve.share == pytest.approx(plain + 2 * (1 - plain) / 3)
