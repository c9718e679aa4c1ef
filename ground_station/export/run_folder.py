"""A run's folder as a source of exports, also while the run goes on and after it was cut short."""

from __future__ import annotations

import json
import logging
import math
import mmap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_station import results
from ground_station.checkpoint import CHECKPOINT_FILE, MAGIC, PREVIOUS_FILE
from ground_station.export.source import Flight, Importance, Progress, unwatched
from ground_station.flown_mission import read_mission
from ground_station.keyframe_log import KEYFRAMES_FILE
from ground_station.mesh_files import read_ply
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.record_file import Data, lay_out
from ground_station.trajectories import UNREADABLE, read_trajectories
from protocol.errors import CovreconError, MessageError, StorageError
from protocol.field import VirtualField
from protocol.messages import Keyframe
from protocol.wire import decode

log = logging.getLogger(__name__)


class RunFolderSource:
    """See `ground_station.export.source.Source`."""

    def __init__(self, path: Path, progress: Progress = unwatched) -> None:
        """Raises MissionError if it is no run's folder."""
        self.path = path
        self._progress = progress
        self.mission = read_mission(path)

    def keyframes(self) -> Iterator[Keyframe]:
        file = self.path / KEYFRAMES_FILE
        if not file.exists():
            raise CovreconError(f"{file}: no keyframes were kept in this run")
        with _contents(file) as data:
            layout = lay_out(data)
            for lost in layout.damaged:
                log.warning("%s: bytes %d to %d are damaged", file, lost.first, lost.last)
            for number, span in enumerate(layout.contents, 1):
                try:
                    yield decode(Keyframe, data[span.first : span.last])
                except MessageError as error:
                    log.warning("%s: keyframe at byte %d: %s", file, span.first, error)
                self._progress("keyframes", number, len(layout.contents))

    def flight(self) -> Flight:
        file = self.path / results.TRAJECTORIES_FILE
        if not file.exists():
            raise CovreconError(f"{file}: no trajectories yet; the first are written with the first checkpoint")
        try:
            return Flight.of(read_trajectories(file))
        except OSError as error:
            raise StorageError(f"{file}: {error.strerror}") from error
        except ValueError as error:
            raise CovreconError(f"{file}: {error}") from error

    def mesh(self) -> Mesh:
        file = self.path / results.MESH_PLY_FILE
        try:
            return read_ply(file.read_bytes(), str(file))
        except FileNotFoundError as error:
            raise CovreconError(
                f"{file}: no map: it is written when a flight has ended; the run's recording has earlier ones"
            ) from error
        except OSError as error:
            raise StorageError(f"{file}: {error.strerror}") from error

    def importance(self) -> Importance:
        field = VirtualField.of(self.mission.target)
        file = self.path / results.PHI_FILE
        if file.exists():
            phi, moment = _phi_of(file), "at the end of the run"
        else:
            file, tick, phi = self._checkpointed()
            moment = f"after {tick * self.mission.tick_s:g} s, from {file.name}"
        if phi.dtype != np.float32 or phi.shape != field.shape:
            raise CovreconError(f"{file}: phi is {phi.dtype} {phi.shape}, the mission's is float32 {field.shape}")
        return Importance(field, phi, moment)

    def _checkpointed(self) -> tuple[Path, int, NDArray[np.float32]]:
        """File, tick and phi of the newest checkpoint that is whole."""
        for file in (self.path / CHECKPOINT_FILE, self.path / PREVIOUS_FILE):
            try:
                return file, *_phi_of_checkpoint(file)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StorageError(f"{file}: {error.strerror}") from error
            except (ValueError, KeyError) as error:
                log.warning("%s: damaged: %s", file, error)
        raise CovreconError(
            f"{self.path}: has neither {results.PHI_FILE}, which is written when a flight has ended, "
            "nor a checkpoint that is whole"
        )


@contextmanager
def _contents(file: Path) -> Iterator[Data]:
    """All that the file holds now, valid inside the block. A writer that is at it may append meanwhile."""
    try:
        stream = file.open("rb")
    except OSError as error:
        raise StorageError(f"{file}: {error.strerror}") from error
    with stream:
        if not file.stat().st_size:
            yield b""
            return
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


def _phi_of(file: Path) -> NDArray[Any]:
    try:
        with file.open("rb") as stream, np.load(stream) as archive:
            phi: NDArray[Any] = archive["phi"]
    except (*UNREADABLE, ValueError) as error:
        raise CovreconError(f"{file}: damaged: {error}") from error
    return phi


def _phi_of_checkpoint(file: Path) -> tuple[int, NDArray[np.float32]]:
    """Tick and phi; the map beside it is left alone. Raises OSError, and ValueError or KeyError if it is damaged."""
    data = file.read_bytes()
    layout = lay_out(data, len(MAGIC))
    if not data.startswith(MAGIC) or not layout.contents or layout.damaged or layout.end < len(data):
        raise ValueError("not a whole checkpoint")
    first, *spans = layout.contents
    description = json.loads(data[first.first : first.last])
    arrays = description["arrays"]
    dtype, shape = arrays["phi"]
    span = dict(zip(arrays, spans, strict=True))["phi"]
    return int(description["tick"]), np.frombuffer(data, dtype, math.prod(shape), span.first).reshape(shape)
