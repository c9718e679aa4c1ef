"""What the ground station knows, on disk as of one moment: after kill -9 it goes on from there.

A checkpoint is one file of records (`ground_station.record_file`): a description in JSON, then each array, so damage
anywhere is seen. It replaces the one before by a rename, which is kept as well: a damaged one costs a period, not all.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import mmap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_station.durable import replace_file, set_aside
from ground_station.mapper import MapState
from ground_station.record_file import head, lay_out, record
from protocol.errors import MissionError, StorageError
from protocol.mission import Mission

log = logging.getLogger(__name__)

CHECKPOINT_FILE, PREVIOUS_FILE = "checkpoint", "checkpoint.previous"
MAGIC = b"covrecon-checkpoint-1\n"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    epoch: int
    """Of the journal."""
    tick: int
    """All earlier ticks are in ``phi`` ..."""
    next_sequence: int
    """... and all jumps below; jumps from here on are the journal's to tell."""
    phi: NDArray[np.float32]
    """(positions, directions)"""
    map: MapState
    totals: Mapping[str, float]
    """Counts since the start of the mission that nothing else on disk tells, by name."""


def save_checkpoint(folder: Path, mission: Mission, checkpoint: Checkpoint) -> None:
    """Write ``folder/checkpoint``; the one before becomes ``checkpoint.previous``. A crash leaves one of them whole.

    The journal may do without the jumps that both have in: those below the ``next_sequence`` of the one before.

    Raises:
        StorageError: the disk refuses it; what was saved before is still there.
    """
    path = folder / CHECKPOINT_FILE
    try:
        replace_file(path, _parts(mission, checkpoint), keep_as=folder / PREVIOUS_FILE)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error


def load_checkpoint(folder: Path, mission: Mission) -> Checkpoint | None:
    """The newest that is whole; a damaged one is set aside. None if there is none.

    Raises:
        MissionError: it is another mission's.
        StorageError: the disk refuses to read it, or to set it aside.
    """
    for path in (folder / CHECKPOINT_FILE, folder / PREVIOUS_FILE):
        try:
            if not path.exists():
                continue
            try:
                return _read(path, mission)
            except ValueError as error:
                aside = set_aside(path).name
                log.error("%s: %s; it is now %s", path, error, aside)  # noqa: TRY400  # the program did nothing wrong
        except OSError as error:
            raise StorageError(f"{path}: {error.strerror}") from error
    return None


def _parts(mission: Mission, checkpoint: Checkpoint) -> Iterator[bytes | memoryview]:
    state = checkpoint.map
    arrays = {"phi": checkpoint.phi, **state.reconstruction}
    little = {name: array.astype(array.dtype.newbyteorder("<"), copy=False) for name, array in arrays.items()}
    description = {
        "mission": _sha256(mission),
        "epoch": checkpoint.epoch,
        "tick": checkpoint.tick,
        "next_sequence": checkpoint.next_sequence,
        "totals": dict(checkpoint.totals),
        "map": {"first": state.first, "end": state.end, "unreadable": state.unreadable, "unlocated": state.unlocated},
        "arrays": {name: [array.dtype.str, array.shape] for name, array in little.items()},
    }
    yield MAGIC
    yield record(json.dumps(description).encode())
    for array in little.values():
        content = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data  # not copied: phi may be large
        yield head(content)
        yield content


def _read(path: Path, mission: Mission) -> Checkpoint:
    """Raises ValueError if it is damaged."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        layout = lay_out(data, len(MAGIC))
        if data[: len(MAGIC)] != MAGIC or not layout.contents or layout.damaged or layout.end < len(data):
            raise ValueError("damaged, or not a checkpoint")
        first, *spans = layout.contents
        description = json.loads(data[first.first : first.last])
        if description["mission"] != _sha256(mission):
            raise MissionError([f"{path}: is of another mission; take a new run folder: --run FOLDER"])
        arrays: dict[str, NDArray[Any]] = {}
        for (name, (dtype, shape)), span in zip(description["arrays"].items(), spans, strict=True):
            arrays[name] = np.frombuffer(data, dtype, math.prod(shape), span.first).reshape(shape).copy()
    return Checkpoint(
        epoch=description["epoch"],
        tick=description["tick"],
        next_sequence=description["next_sequence"],
        phi=arrays.pop("phi"),
        map=MapState(reconstruction=arrays, **description["map"]),
        totals=description["totals"],
    )


def _sha256(mission: Mission) -> str:
    return hashlib.sha256(mission.model_dump_json().encode()).hexdigest()
