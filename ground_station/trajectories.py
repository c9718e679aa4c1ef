"""What each drone flew and how its controller fared, tick by tick: kept in memory, written as a whole."""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_station.durable import replace_file
from protocol.messages import UNLIMITED, Control, DroneState

COORDINATES = 5
"""x, y, z in metres, yaw and pitch in radians."""
UNREADABLE = (OSError, RuntimeError, KeyError, EOFError, struct.error, zlib.error, zipfile.BadZipFile)
"""What zipfile and numpy raise, beside ValueError, on damaged files; found by changing every byte of one."""

_OF_CONTROL = (
    "solve_time_s", "slack", "telemetry_age_s", "separation_margin_m2", "region_margin_m", "pitch_margin_rad2",
    "obstacle_margin_m",
)  # fmt: skip
_UNDECIDED = (math.nan,) * len(_OF_CONTROL)
_ADDED_LATER = (
    "mode", "battery", "separation_margin_m2", "region_margin_m", "pitch_margin_rad2", "obstacle_margin_m",
    "position_sd_m",
)  # fmt: skip
"""Files that were written before these were kept lack them."""


class Trajectories:
    """One thread adds, and one may write at the same time."""

    def __init__(self, drones: Sequence[int]) -> None:
        self._drones = list(drones)
        self._column = {drone: index for index, drone in enumerate(self._drones)}
        self._rows: list[tuple[Any, ...]] = []
        self._flown = self._as_arrays([])

    def add(
        self, tick: int, time_s: float, poses: Mapping[int, Sequence[float]], states: Mapping[int, DroneState]
    ) -> None:
        """``poses`` are what phi was integrated with, ``states`` the newest that each drone told.

        Both go by drone id and may lack drones that were not heard. No state is held on to.
        """
        pose_row = np.full((len(self._drones), COORDINATES), np.nan)
        for drone, pose in poses.items():
            pose_row[self._column[drone]] = pose
        heard = [states.get(drone) for drone in self._drones]
        controls = [None if state is None else state.control for state in heard]
        numbers = [_UNDECIDED if control is None else _numbers(control) for control in controls]
        braked = ["" if control is None or control.outcome == "solved" else control.outcome for control in controls]
        modes = ["" if state is None else state.mode for state in heard]
        batteries = [math.nan if state is None else state.battery for state in heard]
        deviations = [math.nan if state is None else state.position_sd_m for state in heard]
        self._rows.append((tick, time_s, pose_row, numbers, braked, modes, batteries, deviations))

    def write(self, path: Path) -> None:
        """Write all that is flown by now. Raises OSError."""
        content = io.BytesIO()
        arrays: dict[str, Any] = self.arrays()
        np.savez_compressed(content, **arrays)
        replace_file(path, [content.getvalue()])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is flown by now, by the names and in the shapes of the file."""
        return {"drones": np.array(self._drones), **self._settled()}

    def read(self, path: Path) -> None:
        """Go on from what ``path`` holds. Raises OSError, and ValueError if it is damaged or of other drones."""
        flown = read_trajectories(path)
        drones = flown["drones"].tolist()
        if drones != self._drones:
            raise ValueError(f"holds drones {drones}")
        self._flown = {name: flown[name] for name in self._flown}

    def fallbacks(self) -> dict[int, int]:
        """Ticks in which each drone braked instead of following its controller."""
        braked = np.count_nonzero(self._settled()["fallback"] != "", axis=0)
        return dict(zip(self._drones, braked.tolist(), strict=True))

    def fallbacks_among_obstacles(self) -> dict[int, int]:
        """Those in which what was not seen free was so near that it could be a limit."""
        flown = self._settled()
        braked = np.count_nonzero((flown["fallback"] != "") & (flown["obstacle_margin_m"] < UNLIMITED), axis=0)
        return dict(zip(self._drones, braked.tolist(), strict=True))

    def min_obstacle_margin_m(self) -> float | None:
        """The smallest of all; None where there never was one."""
        margins = self._settled()["obstacle_margin_m"]
        margins = margins[margins < UNLIMITED]  # NaN is not
        return float(margins.min()) if margins.size else None

    def _settled(self) -> Mapping[str, NDArray[Any]]:
        """All rows as arrays; those added since the last time are converted now."""
        count = len(self._rows)
        if count:
            rows = self._as_arrays(self._rows[:count])
            self._flown = {name: np.concatenate([known, rows[name]]) for name, known in self._flown.items()}
            del self._rows[:count]
        return self._flown

    def _as_arrays(self, rows: Sequence[tuple[Any, ...]]) -> dict[str, NDArray[Any]]:
        ticks, times, poses, numbers, fallbacks, modes, batteries, deviations = (
            zip(*rows, strict=True) if rows else ((),) * 8
        )
        shape = (len(rows), len(self._drones))
        of_control = np.moveaxis(np.array(numbers, np.float64).reshape(*shape, len(_OF_CONTROL)), -1, 0)
        return {
            "tick": np.array(ticks, dtype=np.int64),
            "time_s": np.array(times, dtype=np.float64),
            "poses": np.array(poses, dtype=np.float64).reshape(*shape, COORDINATES),
            **dict(zip(_OF_CONTROL, of_control, strict=True)),
            "fallback": np.array(fallbacks, dtype=np.str_).reshape(shape),
            "mode": np.array(modes, dtype=np.str_).reshape(shape),
            "battery": np.array(batteries, dtype=np.float64).reshape(shape),
            "position_sd_m": np.array(deviations, dtype=np.float64).reshape(shape),
        }


def read_trajectories(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a file by name; what files of earlier versions lack is "" or NaN.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged.
    """
    content = path.read_bytes()
    try:
        if zipfile.ZipFile(io.BytesIO(content)).testzip() is not None:  # numpy looks into it before it checks it
            raise ValueError("damaged")
        with np.load(io.BytesIO(content)) as file:
            flown = {name: file[name] for name in file.files}
        shape = (len(flown["tick"]), len(flown["drones"]))
        for name in _ADDED_LATER:
            flown.setdefault(name, np.full(shape, "" if name == "mode" else math.nan))
        for name in ("poses", *_OF_CONTROL, "fallback", "mode", "battery", "position_sd_m"):
            if flown[name].shape[:2] != shape:
                raise ValueError(f"damaged: {name} is of shape {flown[name].shape}")
    except UNREADABLE as error:
        raise ValueError(f"damaged: {error}") from error
    return flown


def _numbers(control: Control) -> tuple[float, ...]:
    """In the order of `_OF_CONTROL`."""
    return (
        control.solve_s,
        control.slack,
        control.telemetry_age_s,
        control.separation_margin_m2,
        control.region_margin_m,
        control.pitch_margin_rad2,
        control.obstacle_margin_m,
    )
