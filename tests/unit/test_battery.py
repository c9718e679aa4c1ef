"""The simulated battery empties as the vehicle flies, and a crew changes it on the ground."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.battery_settings import Battery
from protocol.geometry import Floats
from protocol.mission import Drone, Mission
from sim_bridge.battery import VehicleBattery, power_w

SETTINGS = Battery(capacity_wh=10.0, hover_w=100.0, speed_w_per_mps=20.0, climb_w_per_mps=50.0)
STILL = np.zeros(5)
TICK_S = 0.05


def moving(*velocity: float) -> Floats:
    return np.array([*velocity, 0.0, 0.0])


def flown(battery: VehicleBattery, seconds: float, velocity: Floats = STILL, *, down: bool = False) -> VehicleBattery:
    for _ in range(round(seconds / TICK_S)):
        battery.step(TICK_S, velocity, down=down)
    return battery


@pytest.mark.parametrize(
    ("velocity", "watts"),
    [((0, 0, 0), 100), ((0.3, 0.4, 0), 110), ((0, 0, 0.5), 125), ((0, 0, -0.5), 100), ((0.5, 0, 0.2), 120)],
)
def test_speed_and_climbing_take_more_and_coming_down_saves_nothing(
    velocity: tuple[float, float, float], watts: float
) -> None:
    assert power_w(SETTINGS, moving(*velocity)) == pytest.approx(watts)


def test_a_battery_empties_in_the_time_that_its_energy_lasts() -> None:
    assert SETTINGS.hover_s == 360.0
    assert flown(VehicleBattery(SETTINGS), 90.0).share == pytest.approx(0.75)
    assert flown(VehicleBattery(SETTINGS), 400.0).share == 0.0


def test_an_endless_one_stays_full() -> None:
    assert flown(VehicleBattery(Battery()), 1000.0, moving(1, 0, 1)).share == 1.0


def test_on_the_ground_nothing_is_taken_and_nobody_changes_it_unless_asked_to() -> None:
    battery = flown(VehicleBattery(SETTINGS), 90.0)
    assert flown(battery, 600.0, down=True).share == pytest.approx(0.75)


def test_the_crew_changes_it_after_its_time_and_only_while_there_are_spares() -> None:
    battery = VehicleBattery(SETTINGS, swap_s=5.0, spares=1)
    flown(battery, 90.0)
    assert flown(battery, 4.9, down=True).share < 1.0
    assert flown(battery, 0.2, down=True).share == 1.0
    assert flown(battery, 60.0, down=True).share == 1.0, "once a landing"
    flown(battery, 90.0)
    assert flown(battery, 60.0, down=True).share == pytest.approx(0.75), "there is no other one"


def test_a_landing_that_was_too_short_begins_anew() -> None:
    battery = VehicleBattery(SETTINGS, swap_s=5.0)
    flown(battery, 90.0)
    flown(battery, 4.0, down=True)
    flown(battery, 1.0)
    assert flown(battery, 4.0, down=True).share < 1.0


def team(start: tuple[float, float, float, float, float], **tables: object) -> Mission:
    drones = (Drone(id=1, start=(0.0, 0.0, 2.0, 0.0, 1.3)), Drone(id=2, start=start))
    return Mission.model_validate({"drones": drones, **tables})


def test_swapping_endless_batteries_is_refused() -> None:
    with pytest.raises(ValueError, match="never empties"):
        team((2.0, 0.0, 2.0, 0.0, 1.3), vehicles={"battery_swap_s": 10})


def test_drones_that_swap_may_not_start_above_each_other() -> None:
    tables = {"vehicles": {"battery_swap_s": 10}, "simulation": {"battery": {"capacity_wh": 20}}}
    above = (0.0, 0.3, 3.5, 0.0, 1.3)
    assert team(above).drones, "without a swap nobody climbs straight up"
    with pytest.raises(ValueError, match="beside drone 1; to take off and land it takes"):
        team(above, **tables)
