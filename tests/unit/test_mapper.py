"""What the map has taken in is there again after a crash, and nothing that changed before it makes phi jump again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from faults.floor_flight import HEIGHT_M, LEG, MISSION, fly
from ground_station.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from ground_station.keyframe_log import KeyframeLog
from ground_station.mapper import Mapper, MapState
from protocol.depth_image import encode_depth
from protocol.errors import StorageError
from protocol.field import VirtualField
from protocol.map_settings import Feedback, Reconstruction
from protocol.messages import Keyframe
from protocol.mission import Mission

FIELD = VirtualField.of(MISSION.target)
CUT = 8
"""Keyframes at the checkpoint."""


FLIGHT = fly()


@dataclass
class Station:
    """One life of the ground station's map, in a folder that outlives it."""

    folder: Path
    mission: Mission = MISSION
    lives: list[Station] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.lives.append(self)
        self.log = KeyframeLog(self.folder / "keyframes")
        self.mapper = Mapper(self.mission, FIELD, self.folder, self.log)

    def add(self, keyframes: Sequence[Keyframe]) -> None:
        for keyframe in keyframes:
            self.mapper.add([keyframe])

    def killed(self) -> Station:
        """The next life."""
        return Station(self.folder, self.mission, self.lives)

    def faces(self) -> int:
        return len(self.mapper.update(scored=False).mesh.faces)

    def mesh(self) -> tuple[bytes, bytes]:
        mesh = self.mapper.update(scored=False).mesh
        return mesh.vertices.tobytes(), mesh.faces.tobytes()


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    station = Station(tmp_path)
    yield station
    for life in station.lives:
        life.log.close()


def saved(folder: Path, state: MapState) -> MapState:
    """``state`` by way of a checkpoint on disk."""
    phi = np.zeros(FIELD.shape, np.float32)
    save_checkpoint(folder, MISSION, Checkpoint(1, 2, 3, phi, state, {}))
    found = load_checkpoint(folder, MISSION)
    assert found is not None
    return found.map


def test_the_map_of_the_checkpoint_is_there_again(station: Station) -> None:
    station.add(FLIGHT[:CUT])
    state = saved(station.folder, station.mapper.state())
    mesh = station.mesh()
    assert station.faces() > 500
    new = station.killed()
    assert new.mapper.restore(state) == 0
    assert new.mesh() == mesh
    assert new.mapper.refused == station.mapper.refused


def test_keyframes_from_after_the_checkpoint_are_mapped_again(station: Station) -> None:
    station.add(FLIGHT[:CUT])
    state = saved(station.folder, station.mapper.state())
    station.add(FLIGHT[CUT:])
    faces = station.faces()
    new = station.killed()
    assert new.mapper.restore(state) == LEG - CUT
    assert new.faces() == pytest.approx(faces, rel=0.02)
    assert len(new.mapper.finish().mesh.faces) == pytest.approx(len(station.mapper.finish().mesh.faces), rel=0.02)
    assert new.log.count == new.mapper.taken == LEG, "none is logged again"


def test_without_a_checkpoint_the_whole_map_is_made_anew(station: Station) -> None:
    station.add(FLIGHT)
    mesh = station.mesh()
    new = station.killed()
    assert new.mapper.restore(None) == LEG
    assert new.mesh() == mesh


def test_one_life_after_another_ends_with_the_map_of_a_single_life(station: Station, tmp_path: Path) -> None:
    (tmp_path / "single").mkdir()
    single = Station(tmp_path / "single")
    single.add(FLIGHT)
    expected = len(single.mapper.finish().mesh.faces)
    single.log.close()

    state = None
    for start in range(0, LEG, 4):
        station.add(FLIGHT[start : start + 4])
        if start != 4:
            state = saved(station.folder, station.mapper.state())
        station = station.killed()
        station.mapper.restore(state)
    assert station.log.count == LEG
    assert len(station.mapper.finish().mesh.faces) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("method", ["grid", "m3c2"])
@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_a_restart_alone_does_not_make_phi_jump(
    tmp_path: Path, with_checkpoint: bool, method: Literal["grid", "m3c2"]
) -> None:
    feedback = MISSION.feedback.model_copy(update={"method": method})
    station = Station(tmp_path, MISSION.model_copy(update={"feedback": feedback}))
    station.add(FLIGHT[:CUT])
    assert station.mapper.update(scored=False).change.any()
    state = station.mapper.state()
    station.add(FLIGHT[CUT:])
    new = station.killed()
    new.mapper.restore(state if with_checkpoint else None)
    assert not new.mapper.update(scored=False).change.any()
    for life in station.lives:
        life.log.close()


def test_a_repeated_keyframe_stays_refused_after_a_restart(station: Station) -> None:
    station.add(FLIGHT[:CUT])
    new = station.killed()
    new.mapper.restore(saved(station.folder, station.mapper.state()))
    mesh, refused = new.mesh(), new.mapper.refused
    moved = FLIGHT[2].model_copy(update={"position": (0.5, 0.3, HEIGHT_M)})  # far enough to be wanted, but old
    new.add([moved])
    assert new.mapper.refused == refused + 1
    assert new.mesh() == mesh


def test_images_that_cannot_be_read_are_counted_across_a_restart(station: Station) -> None:
    broken = FLIGHT[1].model_copy(update={"jpeg": b"not an image"})
    station.add([FLIGHT[0], broken, FLIGHT[2].model_copy(update={"width": 80})])
    assert station.mapper.refused == 2
    state = saved(station.folder, station.mapper.state())
    station.add([broken])
    new = station.killed()
    new.mapper.restore(state)
    assert new.mapper.refused == 3


@pytest.mark.parametrize("bad", [{"position_sd_m": 0.11}, {"angle_sd_rad": 0.1}])
def test_images_of_a_drone_that_hardly_knows_where_it_is_are_left_out_and_counted(
    station: Station, bad: dict[str, float]
) -> None:
    station.add([FLIGHT[0].model_copy(update={"position_sd_m": 0.1}), FLIGHT[1].model_copy(update=bad)])
    assert (station.mapper.refused, station.mapper.unlocated) == (1, 1)
    state = saved(station.folder, station.mapper.state())
    new = station.killed()
    new.mapper.restore(state)
    assert new.mapper.unlocated == 1
    assert new.mapper.taken == 2, "they are kept all the same"


def test_damage_in_the_log_costs_its_keyframe_and_not_the_map(station: Station) -> None:
    station.add(FLIGHT[:CUT])
    state = saved(station.folder, station.mapper.state())
    mesh = station.mesh()
    station.add(FLIGHT[CUT:])
    path = station.folder / "keyframes"
    content = bytearray(path.read_bytes())
    for place in (state.end // 2, (state.end + len(content)) // 2):
        content[place] ^= 0xFF
    path.write_bytes(content)
    new = station.killed()
    assert new.mapper.restore(state) == LEG - CUT - 1
    assert new.faces() > len(np.frombuffer(mesh[1], np.int32)) / 3


def test_a_log_that_is_gone_leaves_the_map_of_the_checkpoint(station: Station) -> None:
    station.add(FLIGHT[:CUT])
    state = saved(station.folder, station.mapper.state())
    mesh = station.mesh()
    (station.folder / "keyframes").unlink()
    new = station.killed()
    assert new.mapper.restore(state) == 0
    assert new.mesh() == mesh


def test_a_state_that_speaks_of_keyframes_that_are_not_safe_is_an_error(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise StorageError("keyframes: Input/output error")

    station.add(FLIGHT[:2])
    monkeypatch.setattr(station.log, "sync", fail)
    with pytest.raises(StorageError):
        station.mapper.state()


def test_a_mapper_without_a_map_restarts_as_well(tmp_path: Path) -> None:
    bare = MISSION.model_copy(update={"reconstruction": Reconstruction(backend="none")})
    old = Station(tmp_path, bare)
    old.add(FLIGHT[:3])
    state = old.mapper.state()
    assert state.first == state.end == old.log.end
    old.add(FLIGHT[3:5])
    new = old.killed()
    assert new.mapper.restore(state) == 2
    assert new.faces() == 0
    old.log.close()
    new.log.close()


def test_the_mean_time_of_a_feedback_update_is_that_of_the_comparisons_alone(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert station.mapper.feedback_update_s is None
    instants = iter([10.0, 10.5, 20.0, 21.5])
    monkeypatch.setattr("ground_station.mapper.time.perf_counter", lambda: next(instants))
    station.faces()
    station.faces()
    assert station.mapper.feedback_update_s == pytest.approx(1.0)


def test_without_feedback_no_time_of_its_update_is_told(tmp_path: Path) -> None:
    silent = Station(tmp_path, MISSION.model_copy(update={"feedback": Feedback(method="none")}))
    silent.faces()
    assert silent.mapper.feedback_update_s is None
    silent.log.close()


@pytest.mark.parametrize("depth", [b"no image", encode_depth(np.ones((72, 72), np.float32))])
def test_a_keyframe_whose_depth_is_none_is_refused_and_counted(tmp_path: Path, depth: bytes) -> None:
    station = Station(tmp_path)
    station.add([one.model_copy(update={"depth": depth}) for one in FLIGHT[:3]])
    assert station.mapper.refused == 3
    assert station.log.count == 3
    station.log.close()


def test_measured_depth_survives_a_crash_with_its_keyframe(tmp_path: Path) -> None:
    mission = MISSION.model_copy(
        update={"reconstruction": MISSION.reconstruction.model_copy(update={"backend": "depth"})}
    )
    flight = [
        one.model_copy(update={"depth": encode_depth(np.full((54, 96), HEIGHT_M + 1e-3 * one.sequence, np.float32))})
        for one in FLIGHT
    ]
    first = Station(tmp_path, mission)
    first.add(flight)
    expected = first.mapper.finish().mesh
    assert len(expected.faces) > 100
    assert np.median(np.abs(expected.vertices[:, 2])) < 0.02
    first.log.close()

    second = Station(tmp_path, mission)
    assert second.mapper.restore(None) == LEG
    found = second.mapper.finish().mesh
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    second.log.close()
