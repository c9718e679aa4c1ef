"""What recordings add to a report: how the map and the importance came about, and what processes had to say."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ground_station.mesh_files import read_glb
from ground_station.recording.reader import Recording
from ground_station.report.run_data import FieldMoment, History, MapMoment, Mesh
from ground_station.results import PHI_FILE
from protocol.errors import CovreconError, RecordingError
from protocol.field import VirtualField

MAPS, FIELDS = 6, 15
"""How many moments are told at most; they are as evenly spaced as what was recorded allows."""
RECORDINGS = "recording*.mcap"

Content = TypeVar("Content")


def history_of(folder: Path) -> History:
    """Of a run's folder: from its recordings, as far as they can be read, and from the final importance.

    Raises CovreconError naming the final importance if it is damaged.
    """
    recordings, notes = [], []
    # A ground station that was started again has written recording-2.mcap, and so on.
    for path in sorted(folder.glob(RECORDINGS), key=lambda path: (len(path.name), path.name)):
        try:
            recordings.append(Recording.open(path, salvage=True))
        except RecordingError as error:
            notes.append(str(error))
    history = read_history(recordings)
    return History(
        maps=history.maps,
        fields=[*history.fields, *_final_field(folder / PHI_FILE)],
        events=history.events,
        notes=[*notes, *history.notes],
    )


def read_history(recordings: Sequence[Recording]) -> History:
    """Of the recordings of one run, the earliest first. Raises RecordingError where one is damaged."""
    maps, fields, notes = [], [], []
    for recording, tick, content in _spread(recordings, Recording.meshes, MAPS):
        found = read_glb(content, f"{recording.path}: map of tick {tick}")
        mesh = Mesh(found.vertices, found.faces, found.colors)
        maps.append(MapMoment(tick * recording.mission.tick_s, mesh))
    for recording, tick, (positions, importance) in _spread(recordings, _fields, FIELDS):
        fields.append(FieldMoment(tick * recording.mission.tick_s, positions, importance))
    for recording in recordings:
        if not recording.complete:
            notes.append(f"{recording.path.name} ends before the flight did.")
        notes += [f"{recording.path.name} lacks {count:,} messages of {name}: there was no room for them."
                  for name, count in recording.losses().items()]  # fmt: skip
    return History(maps, fields, [event for recording in recordings for event in recording.events()], notes)


def _spread(
    recordings: Sequence[Recording], read: Callable[[Recording], Iterator[tuple[int, Content]]], most: int
) -> Iterator[tuple[Recording, int, Content]]:
    """Of what ``read`` gives with ticks, the contents nearest to ``most`` evenly spaced moments.

    It reads twice, rather than keep them all in memory.
    """
    ticks = np.array([tick for recording in recordings for tick, _ in read(recording)])
    if not len(ticks):
        return
    wished = np.linspace(0, ticks.max(), most + 1)[1:]
    chosen = set(np.abs(ticks[:, None] - wished).argmin(axis=0).tolist())
    entries = ((recording, *entry) for recording in recordings for entry in read(recording))
    yield from (entry for number, entry in enumerate(entries) if number in chosen)


def _fields(recording: Recording) -> Iterator[tuple[int, tuple[NDArray[np.float32], NDArray[np.float32]]]]:
    return ((tick, (positions, importance)) for tick, positions, importance in recording.fields())


def _final_field(path: Path) -> Iterator[FieldMoment]:
    """Nothing if the run was cut short."""
    if not path.exists():
        return
    try:
        with path.open("rb") as stream, np.load(stream) as file:
            field = VirtualField(file["xs"], file["ys"], file["zs"], file["directions"])
            importance = file["phi"].mean(axis=1, dtype=np.float64).astype(np.float32)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise CovreconError(f"{path}: {error}") from error
    yield FieldMoment(math.inf, field.positions().astype(np.float32), importance)
