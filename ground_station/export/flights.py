"""What was flown, as tables (CSV) and as trajectories in the format of the TUM RGB-D benchmark, which ``evo`` reads."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ground_station.export.georeference import Georeference
from ground_station.export.output import Exported, write_georeference
from ground_station.export.source import Flight, Source
from protocol.errors import CovreconError
from protocol.geometry import camera_rotation

FlightFormat: TypeAlias = Literal["csv", "tum"]

TEAM_FILE = "trajectories.csv"
TUM_HEADER = (
    "# mission time in s, position x y z in m, quaternion x y z w: of the camera's optical frame (x right, y down, z "
    "forward) in the world frame (x east, y north, z up)"
)
DECIMALS = 6
"""Micrometres and microseconds, as in all files of a run."""
DEGREE_DECIMALS = 9
"""1e-9 degrees are a tenth of a millimetre."""
_POSE = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad")
_PLACE = ("latitude_deg", "longitude_deg", "altitude_m")


def export_flight(source: Source, folder: Path, formats: Sequence[FlightFormat]) -> Exported:
    """Write one CSV for the team and one a drone, and one TUM file a drone.

    Raises CovreconError, and OSError if the disk refuses it.
    """
    flight = source.flight()
    heard = np.logical_and.reduce(np.isfinite(flight.poses), axis=2)
    if not heard.any():
        raise CovreconError(f"{source.path}: nobody has flown yet")
    georeference = Georeference.of(source.mission)
    if "csv" in formats:
        tables = [_table(flight, column, georeference) for column in range(len(flight.drones))]
        header = _header(flight, georeference)
        for drone, rows in zip(flight.drones, tables, strict=True):
            _write_csv(folder / f"drone_{drone}.csv", header, rows)
        together = sorted((row for rows in tables for row in rows), key=lambda row: (row[0], row[2]))
        _write_csv(folder / TEAM_FILE, header, together)
    if "tum" in formats:
        for column, drone in enumerate(flight.drones):
            lines = "".join(line + "\n" for line in tum_lines(flight, column))
            (folder / f"drone_{drone}.tum").write_text(lines, encoding="ascii")
    write_georeference(folder, georeference)
    silent = [drone for column, drone in enumerate(flight.drones) if not heard[:, column].any()]
    notes = tuple(f"drone {drone} was never heard" for drone in silent)
    return Exported(folder, f"{np.count_nonzero(heard)} poses of {len(flight.drones)} drones", notes)


def tum_lines(flight: Flight, column: int) -> Iterator[str]:
    """One drone's camera poses; ticks in which it was not heard are left out."""
    yield TUM_HEADER
    for time_s, pose in zip(flight.time_s, flight.poses[:, column], strict=True):
        if not np.isfinite(pose).all():
            continue
        quaternion = Rotation.from_matrix(camera_rotation(pose[3], pose[4])).as_quat(canonical=True)
        numbers = " ".join(f"{value:.9f}" for value in (*pose[:3], *quaternion))
        yield f"{time_s:.{DECIMALS}f} {numbers}"


def _header(flight: Flight, georeference: Georeference | None) -> list[str]:
    return ["tick", "time_s", "drone", *_POSE, *(_PLACE if georeference else ()), *flight.columns]


def _table(flight: Flight, column: int, georeference: Georeference | None) -> list[list[Any]]:
    """Rows of one drone; ticks in which it was not heard are left out."""
    heard = np.isfinite(flight.poses[:, column]).all(axis=1)
    poses = flight.poses[heard, column]
    parts = [_cells(flight.tick[heard]), _cells(flight.time_s[heard]), [flight.drones[column]] * len(poses)]
    parts += [_cells(axis) for axis in poses.T]
    if georeference is not None:
        latitude, longitude, altitude = georeference.geodetic(poses).T
        parts += [_cells(latitude, DEGREE_DECIMALS), _cells(longitude, DEGREE_DECIMALS), _cells(altitude)]
    parts += [_cells(values[heard, column]) for values in flight.columns.values()]
    return [list(row) for row in zip(*parts, strict=True)]


def _cells(values: NDArray[Any], decimals: int = DECIMALS) -> list[Any]:
    """Numbers rounded, what is not finite as an empty cell; words as they are."""
    if values.dtype.kind != "f":
        return list(values.tolist())
    rounded = np.round(values, decimals)
    return [number if finite else "" for number, finite in zip(rounded.tolist(), np.isfinite(values), strict=True)]


def _write_csv(file: Path, header: list[str], rows: list[list[Any]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
