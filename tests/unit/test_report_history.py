"""What a report takes from the recordings of its run, whole or torn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.recorder import Recorder
from ground_station.report.history import FIELDS, MAPS, history_of
from protocol import topics
from protocol.errors import CovreconError
from protocol.field import VirtualField
from protocol.messages import Event
from protocol.mission import Drone, Mission

MISSION = Mission.model_validate(
    {"name": "m", "drones": [Drone(id=1, start=(0, 0, 2, 0, 1.3))], "recording": {"mesh_period_s": 1.0}}
)
PERIOD = 20
"""Ticks between two maps."""
SHAPE = VirtualField.of(MISSION.target).shape


def square(faces: int) -> Mesh:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]] * faces, np.int32)[:faces], np.full((4, 3), 200, np.uint8))


def record(path: Path, first: int, last: int) -> None:
    """A second a step: a map with a face more each time, and an importance that falls."""
    with Recorder(path, MISSION, lossless=True) as recorder:
        for step in range(first, last):
            recorder.mesh(step * PERIOD, square(step + 1))
            recorder.phi(step * PERIOD, np.full(SHAPE, 1 / (1 + step), np.float32))
        event = Event(source="ground", tick=last * PERIOD, level="warning", kind="map", text=f"step {last}")
        recorder.heard(topics.GROUND_EVENT, event, event.tick)


def test_maps_and_fields_are_spread_over_all_recordings_of_a_run(tmp_path: Path) -> None:
    record(tmp_path / "recording.mcap", 0, 30)
    record(tmp_path / "recording-2.mcap", 30, 61)
    history = history_of(tmp_path)
    assert [moment.time_s for moment in history.maps] == [10, 20, 30, 40, 50, 60]
    assert [len(moment.mesh.faces) for moment in history.maps] == [11, 21, 31, 41, 51, 61]
    assert [moment.time_s for moment in history.fields] == list(range(4, 61, 4))
    assert (len(history.maps), len(history.fields)) == (MAPS, FIELDS)
    assert [moment.importance[0] for moment in history.fields] == pytest.approx([1 / (1 + s) for s in range(4, 61, 4)])
    np.testing.assert_allclose(history.fields[0].positions, VirtualField.of(MISSION.target).positions(), rtol=1e-6)
    assert [event.text for event in history.events] == ["step 30", "step 61"]


def test_few_maps_are_all_told_once(tmp_path: Path) -> None:
    record(tmp_path / "recording.mcap", 0, 3)
    assert [moment.time_s for moment in history_of(tmp_path).maps] == [0, 1, 2]


def test_a_map_comes_back_where_it_was_in_its_colours(tmp_path: Path) -> None:
    record(tmp_path / "recording.mcap", 1, 2)
    (moment,) = history_of(tmp_path).maps
    np.testing.assert_allclose(moment.mesh.vertices, square(2).vertices, atol=1e-7)
    np.testing.assert_array_equal(moment.mesh.faces, square(2).faces)
    np.testing.assert_allclose(moment.mesh.colours, 200, atol=1)


def test_of_a_torn_recording_the_whole_part_is_told_and_that_it_is_torn(tmp_path: Path) -> None:
    record(tmp_path / "recording.mcap", 0, 10)
    content = (tmp_path / "recording.mcap").read_bytes()
    (tmp_path / "recording.mcap").write_bytes(content[: len(content) // 2])
    history = history_of(tmp_path)
    assert 0 < history.maps[-1].time_s < 9
    assert history.notes == ["recording.mcap ends before the flight did."]


def test_what_is_no_recording_is_said_and_hides_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "recording.mcap").write_bytes(b"nonsense")
    record(tmp_path / "recording-2.mcap", 0, 3)
    history = history_of(tmp_path)
    assert len(history.maps) == 3
    assert history.notes[0] == f"{tmp_path / 'recording.mcap'}: not an MCAP file"


def test_a_folder_without_recordings_has_the_final_importance_alone(tmp_path: Path) -> None:
    field = VirtualField.of(MISSION.target)
    phi = np.random.default_rng(1).random(field.shape, np.float32)
    lattice = {"xs": field.xs, "ys": field.ys, "zs": field.zs, "directions": field.directions}
    np.savez_compressed(tmp_path / "phi.npz", phi=phi, **lattice)
    (final,) = history_of(tmp_path).fields
    assert final.time_s == np.inf
    np.testing.assert_allclose(final.importance, phi.mean(axis=1), rtol=1e-5)
    (tmp_path / "phi.npz").write_bytes(b"PK")
    with pytest.raises(CovreconError, match=r"phi\.npz"):
        history_of(tmp_path)
