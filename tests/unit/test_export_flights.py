"""Trajectories, opened with evo and as tables."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from faults.flown import CAMERAS, ORIGIN, TICKS, Flown, a_flight, write_folder
from ground_station.export.flights import export_flight
from ground_station.export.georeference import Georeference
from ground_station.export.source import Flight, open_source
from protocol.errors import CovreconError
from protocol.geometry import optical_axis

TICK_S = 0.05


@pytest.fixture(scope="module")
def flown() -> Flown:
    return a_flight(ORIGIN)


@pytest.fixture(scope="module")
def exported(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trajectories")
    export_flight(open_source(write_folder(flown, tmp_path_factory.mktemp("run"))), folder, ("csv", "tum"))
    return folder


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("drone", CAMERAS)
def test_evo_reads_the_camera_where_it_was_and_looking_where_it_looked(
    exported: Path, flown: Flown, drone: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # where it keeps its settings
    from evo.tools import file_interface

    read = file_interface.read_tum_trajectory_file(exported / f"drone_{drone}.tum")
    valid, details = read.check()
    assert valid, details
    states = [states[drone] for states in flown.states.values() if drone in states]
    np.testing.assert_allclose(read.timestamps, [state.tick * TICK_S for state in states], atol=1e-6)
    np.testing.assert_allclose(read.positions_xyz, [state.pose[:3] for state in states], atol=1e-8)
    forward = np.array(read.poses_se3)[:, :3, 2]
    np.testing.assert_allclose(forward, [optical_axis(*state.pose[3:]) for state in states], atol=1e-8)
    right = np.array(read.poses_se3)[:, :3, 0]
    np.testing.assert_allclose(right[:, 2], 0.0, atol=1e-8)


def test_a_drone_s_table_has_every_tick_in_which_it_was_heard(exported: Path, flown: Flown) -> None:
    table = rows(exported / "drone_2.csv")
    heard = [tick for tick, states in flown.states.items() if 2 in states]
    assert len(heard) < TICKS
    assert [int(row["tick"]) for row in table] == heard
    first, second = table[:2]
    state = flown.states[1][2]
    assert (first["drone"], first["solve_time_s"], first["slack"]) == ("2", "", "")
    assert float(second["time_s"]) == TICK_S
    names = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad")
    assert [float(second[name]) for name in names] == [round(value, 6) for value in state.pose]
    assert state.control is not None
    assert float(second["solve_time_s"]) == pytest.approx(state.control.solve_s, abs=1e-6)
    assert (second["mode"], float(second["battery"])) == ("flying", state.battery)
    assert (float(second["separation_margin_m2"]), float(second["region_margin_m"])) == (2.0, 0.5)


def test_the_team_s_table_has_all_rows_by_tick_and_drone(exported: Path) -> None:
    together = rows(exported / "trajectories.csv")
    apart = [row for drone in CAMERAS for row in rows(exported / f"drone_{drone}.csv")]
    assert together == sorted(apart, key=lambda row: (int(row["tick"]), int(row["drone"])))
    braked = [(row["tick"], row["drone"]) for row in together if row["fallback"]]
    assert braked == [("5", "1")]


def test_tables_of_a_georeferenced_mission_have_the_place_on_earth(exported: Path) -> None:
    table = rows(exported / "trajectories.csv")
    places = [[float(row[name]) for name in ("latitude_deg", "longitude_deg", "altitude_m")] for row in table]
    local = [[float(row[name]) for name in ("x_m", "y_m", "z_m")] for row in table]
    np.testing.assert_allclose(places, Georeference(*ORIGIN).geodetic(np.array(local)), atol=2e-6)
    assert (exported / "georeference.json").exists()


def test_a_mission_without_an_origin_has_no_place(tmp_path: Path) -> None:
    source = open_source(write_folder(a_flight(), tmp_path / "run"))
    export_flight(source, tmp_path, ("csv",))
    assert "latitude_deg" not in rows(tmp_path / "trajectories.csv")[0]
    assert not (tmp_path / "georeference.json").exists()
    assert not list(tmp_path.glob("*.tum"))


class OnlyFlight:
    """A source that has nothing but a flight."""

    def __init__(self, flown: Flown, flight: Flight) -> None:
        self.path = Path("run")
        self.mission = flown.mission
        self._flight = flight

    def flight(self) -> Flight:
        return self._flight


def test_a_drone_that_was_never_heard_is_told(flown: Flown, tmp_path: Path) -> None:
    poses = np.full((3, 2, 5), np.nan)
    poses[:, 0] = 1.0
    flight = Flight((1, 2), np.arange(3), np.arange(3) * TICK_S, poses, {})
    exported = export_flight(OnlyFlight(flown, flight), tmp_path, ("csv", "tum"))  # type: ignore[arg-type]
    assert exported.notes == ("drone 2 was never heard",)
    assert exported.content == "3 poses of 2 drones"
    assert rows(tmp_path / "drone_2.csv") == []


def test_nothing_is_written_when_nobody_has_flown(flown: Flown, tmp_path: Path) -> None:
    flight = Flight((1,), np.arange(3), np.arange(3) * TICK_S, np.full((3, 1, 5), np.nan), {})
    with pytest.raises(CovreconError, match="nobody has flown"):
        export_flight(OnlyFlight(flown, flight), tmp_path, ("csv",))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
