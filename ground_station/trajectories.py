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
from protocol.messages import Control

COORDINATES = 5
"""x, y, z in metres, yaw and pitch in radians."""
UNREADABLE = (OSError, RuntimeError, KeyError, EOFError, struct.error, zlib.error, zipfile.BadZipFile)
"""What zipfile and numpy raise, beside ValueError, on damaged files; found by changing every byte of one."""

_UNHEARD = (math.nan,) * 3
"""Solve time, slack and age of the telemetry of a drone that has decided nothing."""


class Trajectories:
    """One thread adds, and one may write at the same time."""

    def __init__(self, drones: Sequence[int]) -> None:
        self._drones = list(drones)
        self._column = {drone: index for index, drone in enumerate(self._drones)}
        self._rows: list[tuple[Any, ...]] = []
        self._flown = self._as_arrays([])

    def add(
        self,
        tick: int,
        time_s: float,
        poses: Mapping[int, Sequence[float]],
        controls: Mapping[int, Control],
    ) -> None:
        """Every mapping goes by drone id and may lack drones that were not heard."""
        pose_row = np.full((len(self._drones), COORDINATES), np.nan)
        for drone, pose in poses.items():
            pose_row[self._column[drone]] = pose
        heard = [controls.get(drone) for drone in self._drones]
        numbers = [_UNHEARD if each is None else (each.solve_s, each.slack, each.telemetry_age_s) for each in heard]
        braked = ["" if each is None or each.outcome == "solved" else each.outcome for each in heard]
        self._rows.append((tick, time_s, pose_row, numbers, braked))

    def write(self, path: Path) -> None:
        """Write all that is flown by now. Raises OSError."""
        content = io.BytesIO()
        arrays: dict[str, Any] = {"drones": np.array(self._drones), **self._settled()}
        np.savez_compressed(content, **arrays)
        replace_file(path, [content.getvalue()])

    def read(self, path: Path) -> None:
        """Go on from what ``path`` holds. Raises OSError, and ValueError if it is damaged or of other drones."""
        content = path.read_bytes()
        try:
            if zipfile.ZipFile(io.BytesIO(content)).testzip() is not None:  # numpy looks into it before it checks it
                raise ValueError("damaged")
            with np.load(io.BytesIO(content)) as file:
                flown = {name: file[name] for name in self._flown}
                drones = file["drones"].tolist()
        except UNREADABLE as error:
            raise ValueError(f"damaged: {error}") from error
        if drones != self._drones:
            raise ValueError(f"holds drones {drones}")
        self._flown = flown

    def fallbacks(self) -> dict[int, int]:
        """Ticks in which each drone braked instead of following its controller."""
        braked = np.count_nonzero(self._settled()["fallback"] != "", axis=0)
        return dict(zip(self._drones, braked.tolist(), strict=True))

    def _settled(self) -> Mapping[str, NDArray[Any]]:
        """All rows as arrays; those added since the last time are converted now."""
        count = len(self._rows)
        if count:
            rows = self._as_arrays(self._rows[:count])
            self._flown = {name: np.concatenate([known, rows[name]]) for name, known in self._flown.items()}
            del self._rows[:count]
        return self._flown

    def _as_arrays(self, rows: Sequence[tuple[Any, ...]]) -> dict[str, NDArray[Any]]:
        ticks, times, poses, numbers, fallbacks = zip(*rows, strict=True) if rows else ((),) * 5
        shape = (len(rows), len(self._drones))
        solve_times, slacks, ages = np.moveaxis(np.array(numbers, np.float64).reshape(*shape, len(_UNHEARD)), -1, 0)
        return {
            "tick": np.array(ticks, dtype=np.int64),
            "time_s": np.array(times, dtype=np.float64),
            "poses": np.array(poses, dtype=np.float64).reshape(*shape, COORDINATES),
            "solve_time_s": solve_times,
            "slack": slacks,
            "telemetry_age_s": ages,
            "fallback": np.array(fallbacks, dtype=np.str_).reshape(shape),
        }
