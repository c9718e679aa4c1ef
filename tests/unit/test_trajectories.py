"""What each drone flew, kept tick by tick: nothing told is lost, nothing untold is invented."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from faults.told import told
from ground_station.trajectories import Trajectories, read_trajectories

POSE = (1.0, 2.0, 3.0, 0.1, 1.2)
LATER = (
    "mode", "battery", "separation_margin_m2", "region_margin_m", "pitch_margin_rad2", "obstacle_margin_m",
    "position_sd_m",
)  # fmt: skip


def flown(ticks: int = 3) -> Trajectories:
    """Drone 2 flies; drone 5 is heard from tick 1 on, and has not decided anything yet."""
    trajectories = Trajectories([2, 5])
    for tick in range(ticks):
        states = {2: told(margins=(0.5 - tick, 1.5, 0.25), battery=0.9 - 0.1 * tick)}
        if tick:
            states[5] = told(mode="joining", battery=0.5, decided=False)
        trajectories.add(tick, tick / 20, {2: POSE}, states)
    return trajectories


def test_margins_modes_and_batteries_are_kept_by_tick_and_drone(tmp_path: Path) -> None:
    flown().write(tmp_path / "flown.npz")
    arrays = read_trajectories(tmp_path / "flown.npz")
    assert arrays["mode"].tolist() == [["flying", ""], ["flying", "joining"], ["flying", "joining"]]
    nan = np.nan
    np.testing.assert_allclose(arrays["battery"], [[0.9, nan], [0.8, 0.5], [0.7, 0.5]])
    np.testing.assert_allclose(arrays["separation_margin_m2"], [[0.5, nan], [-0.5, nan], [-1.5, nan]])
    np.testing.assert_allclose(arrays["region_margin_m"][:, 0], 1.5)
    np.testing.assert_allclose(arrays["pitch_margin_rad2"][:, 0], 0.25)
    np.testing.assert_allclose(arrays["telemetry_age_s"][:, 0], 0.01)
    assert np.isnan(arrays["poses"][:, 1]).all()
    assert np.isnan(arrays["solve_time_s"][:, 1]).all()


def test_a_file_of_an_earlier_version_is_read_and_gone_on_with(tmp_path: Path) -> None:
    arrays = flown().arrays()
    np.savez_compressed(tmp_path / "old.npz", **{name: arrays[name] for name in arrays if name not in LATER})
    trajectories = Trajectories([2, 5])
    trajectories.read(tmp_path / "old.npz")
    trajectories.add(3, 0.15, {2: POSE}, {2: told(mode="landing")})
    mode, margin = trajectories.arrays()["mode"], trajectories.arrays()["region_margin_m"]
    assert mode.tolist() == [["", ""]] * 3 + [["landing", ""]]
    np.testing.assert_allclose(margin, [[np.nan, np.nan]] * 3 + [[1.0, np.nan]])
    assert trajectories.min_obstacle_margin_m() is None, "neither a row of which nobody told nor one that is not there"


def test_how_near_drones_came_to_obstacles_and_braked_among_them_is_counted() -> None:
    trajectories = Trajectories([2, 5])
    for tick, margin in enumerate((0.4, -0.03, 0.2)):
        near = told(obstacle_m=margin, outcome="infeasible" if tick else "solved", position_sd_m=0.01)
        far = told(outcome="infeasible")
        trajectories.add(tick, tick / 20, {2: POSE}, {2: near, 5: far})

    assert trajectories.min_obstacle_margin_m() == -0.03
    assert trajectories.fallbacks_among_obstacles() == {2: 2, 5: 0}
    assert trajectories.fallbacks() == {2: 2, 5: 3}
    np.testing.assert_allclose(trajectories.arrays()["position_sd_m"], [[0.01, 0.0]] * 3)


def test_after_reading_the_same_rows_follow_as_without(tmp_path: Path) -> None:
    flown(2).write(tmp_path / "flown.npz")
    again = Trajectories([2, 5])
    again.read(tmp_path / "flown.npz")
    again.add(2, 0.1, {2: POSE}, {2: told(margins=(-1.5, 1.5, 0.25), battery=0.7), 5: told(
        mode="joining", battery=0.5, decided=False)})  # fmt: skip
    for name, expected in flown(3).arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], expected, name)


@pytest.mark.parametrize("name", ["tick", "drones", "poses", "slack"])
def test_a_file_that_lacks_an_array_is_damaged(tmp_path: Path, name: str) -> None:
    arrays = flown().arrays()
    del arrays[name]
    np.savez_compressed(tmp_path / "flown.npz", **arrays)
    with pytest.raises(ValueError, match=f"damaged.*{name}"):
        read_trajectories(tmp_path / "flown.npz")


def test_arrays_of_different_length_are_damaged(tmp_path: Path) -> None:
    arrays = flown().arrays()
    np.savez_compressed(tmp_path / "flown.npz", **{**arrays, "battery": arrays["battery"][1:]})
    with pytest.raises(ValueError, match="damaged: battery"):
        read_trajectories(tmp_path / "flown.npz")
