"""A short flight that never was, as a run's folder and as a recording: what exports, reports and replays begin from.

Two drones with different cameras look down at `MARK`, which is a bright spot in every image, at the place where the
conventions of `protocol.geometry` put it. Who reads poses, intrinsics and images in another format finds it there.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ground_station import results
from ground_station.checkpoint import Checkpoint, save_checkpoint
from ground_station.evaluation import Score, Scores
from ground_station.keyframe_log import KEYFRAMES_FILE, KeyframeLog
from ground_station.mapper import MapState
from ground_station.mesh_files import ply
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.recorder import Recorder
from ground_station.results import Metrics, Summary
from ground_station.trajectories import Trajectories
from protocol import topics
from protocol.field import VirtualField
from protocol.geometry import Floats, camera_rotation, optical_axis
from protocol.importance import ImportanceField
from protocol.messages import Control, DroneState, Jump, Keyframe, ReplicaState
from protocol.mission import Mission
from protocol.replica import Replica
from protocol.replication import Integrated

MARK = np.array([0.4, -0.3, 0.2])
"""World, metres."""
ORIGIN = (47.397742, 8.545594, 488.0)
"""Latitude, longitude, altitude of PX4's favourite field."""
TICKS = 60
KEYFRAME_TICKS = 10
WIDTH, HEIGHT = 96, 72
CAMERAS = {1: (70.0, 70.0, 48.0, 36.0), 2: (80.0, 78.0, 45.5, 38.25)}
"""fx, fy, cx, cy of each drone's."""
SPOT_PX = 1.5
DARK, BRIGHT = 60, 240
EPOCH = 7


def a_mission(origin: tuple[float, float, float] | None = None) -> Mission:
    starts = [{"id": drone, "start": tuple(pose_at(drone, 0).tolist())} for drone in CAMERAS]
    return Mission.model_validate(
        {
            "name": "flown",
            "duration_s": 10.0,
            "target": {"cell_m": 1.0, "cell_rad": 1.0},
            "drones": tuple(starts),
            "vehicles": {"origin": origin},
        }
    )


def pose_at(drone: int, tick: int) -> Floats:
    """(5,): on an arc above `MARK`, at which the camera looks, but not with its middle."""
    yaw = math.pi * drone + tick / 40
    pitch = 1.2 + 0.2 * math.sin(tick / 15)
    aside = 0.15 * camera_rotation(yaw, pitch)[:, 0] + 0.1 * camera_rotation(yaw, pitch)[:, 1]
    return np.array([*(MARK - 2.0 * optical_axis(yaw, pitch) + aside), yaw, pitch])


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    mission: Mission
    states: Mapping[int, Mapping[int, DroneState]]
    """By tick and drone; in some ticks drone 2 is not heard."""
    keyframes: tuple[Keyframe, ...]
    jump: Jump
    mesh: Mesh
    phi: NDArray[np.float32]
    """At the end."""

    def poses(self, tick: int) -> tuple[list[int], Floats]:
        heard = self.states[tick]
        return sorted(heard), np.array([heard[drone].pose for drone in sorted(heard)])


def a_flight(origin: tuple[float, float, float] | None = None) -> Flown:
    mission = a_mission(origin)
    states = {
        tick: {drone: _state(drone, tick) for drone in CAMERAS if (drone, tick % 20) != (2, 7)} for tick in range(TICKS)
    }
    keyframes = tuple(a_keyframe(drone, tick) for tick in range(0, TICKS, KEYFRAME_TICKS) for drone in CAMERAS)
    field = VirtualField.of(mission.target)
    jump = Jump(
        epoch=EPOCH, sequence=0, tick=TICKS // 2, increments=np.linspace(0, 0.3, field.shape[0], dtype=np.float32)
    )
    replica = Replica(ImportanceField(field, mission.sensing))
    flown = Flown(mission, states, keyframes, jump, a_table_on_a_floor(), replica.field.phi)
    replica.hear(jump)
    for tick in range(TICKS):
        replica.advance(tick, flown.poses(tick)[1], mission.tick_s)
    return flown


def _state(drone: int, tick: int) -> DroneState:
    pose = tuple(pose_at(drone, tick).tolist())
    control = Control(
        tick=max(0, tick - 1),
        outcome="infeasible" if (drone, tick) == (1, 5) else "solved",
        velocity=(0.0,) * 5,
        slack=-0.1 * drone,
        sampling=0.0,
        solve_s=0.001 + 1e-5 * tick,
        separation_margin_m2=2.0,
        region_margin_m=0.5,
        pitch_margin_rad2=0.1,
        active=(),
        fallbacks=0,
        refused=0,
    )
    replica = ReplicaState(tick=tick, epoch=EPOCH, next_jump=0, missing=0, repaired=0, lost=0)
    return DroneState(
        drone=drone,
        tick=tick,
        pose=pose,
        velocity=(0.0,) * 5,
        battery=1.0 - tick / 1000,
        mode="flying",
        importance=1.0,
        replica=replica,
        control=control if tick else None,
    )


def a_keyframe(drone: int, tick: int) -> Keyframe:
    pose = pose_at(drone, tick)
    rotation = camera_rotation(pose[3], pose[4])
    right, down, forward = rotation.tolist()
    fx, fy, cx, cy = CAMERAS[drone]
    x, y, z = rotation.T @ (MARK - pose[:3])
    return Keyframe(
        drone=drone,
        sequence=tick // KEYFRAME_TICKS,
        tick=tick,
        position=tuple(pose[:3].tolist()),
        rotation=(tuple(right), tuple(down), tuple(forward)),
        width=WIDTH,
        height=HEIGHT,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        jpeg=_image_of_a_spot(fx * x / z + cx, fy * y / z + cy),
    )


def _image_of_a_spot(column: float, row: float) -> bytes:
    across, down = np.arange(WIDTH) + 0.5 - column, np.arange(HEIGHT) + 0.5 - row
    spot = np.exp(-(across[None, :] ** 2 + down[:, None] ** 2) / (2 * SPOT_PX**2))
    grey = np.round(DARK + (BRIGHT - DARK) * spot).astype(np.uint8)
    content = io.BytesIO()
    Image.fromarray(np.repeat(grey[:, :, None], 3, axis=2)).save(content, "JPEG", quality=98, subsampling=0)
    return content.getvalue()


def spot_in(jpeg: Path) -> Floats:
    """(2,) column and row of the bright spot's centre, to a twentieth of a pixel."""
    with Image.open(jpeg) as image:
        above = np.clip(np.asarray(image.convert("L"), np.float64) - DARK - 10, 0, None)
    rows, columns = np.indices(above.shape) + 0.5
    centre: Floats = np.array([(columns * above).sum(), (rows * above).sum()]) / above.sum()
    return centre


def a_table_on_a_floor() -> Mesh:
    """A blue floor of 6 m x 6 m and a red square of 1 m x 1 m, 1 m above it."""
    floor = [[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]]
    top = [[1, 1, 1], [2, 1, 1], [2, 2, 1], [1, 2, 1]]
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    colours = np.array([(40, 60, 200)] * 4 + [(200, 40, 40)] * 4, np.uint8)
    return Mesh(np.array(floor + top, np.float32), faces, colours)


def write_folder(flown: Flown, folder: Path, *, finished: bool = True) -> Path:
    """What the run leaves behind; if it was cut short, a checkpoint in place of phi and the map."""
    folder.mkdir(parents=True, exist_ok=True)
    mission = flown.mission
    (folder / results.MISSION_FILE).write_text(mission.model_dump_json())
    trajectories = Trajectories(list(CAMERAS))
    for tick, states in flown.states.items():
        poses = {drone: state.pose for drone, state in states.items()}
        trajectories.add(tick, tick * mission.tick_s, poses, states)
    trajectories.write(folder / results.TRAJECTORIES_FILE)
    with KeyframeLog(folder / KEYFRAMES_FILE) as log:
        for keyframe in flown.keyframes:
            log.append(keyframe)
    if not finished:
        state = MapState(reconstruction={"received": np.array(3)}, first=0, end=0, unreadable=0)
        checkpoint = Checkpoint(epoch=EPOCH, tick=TICKS, next_sequence=1, phi=flown.phi, map=state, totals={})
        save_checkpoint(folder, mission, checkpoint)
        return folder
    field = VirtualField.of(mission.target)
    lattice: dict[str, Any] = {"xs": field.xs, "ys": field.ys, "zs": field.zs, "directions": field.directions}
    np.savez_compressed(folder / results.PHI_FILE, phi=flown.phi, **lattice)
    mesh = flown.mesh
    (folder / results.MESH_PLY_FILE).write_bytes(ply(mesh.vertices, mesh.faces, mesh.colors))
    (folder / results.SUMMARY_FILE).write_text(json.dumps(_summary(flown).as_json()))
    return folder


def write_recording(flown: Flown, path: Path, *, finished: bool = True) -> Path:
    """The same as a recording; one that was cut short has earlier maps, but no summary."""
    with Recorder(path, flown.mission, lossless=True) as recorder:
        recorder.mesh(0, flown.mesh)
        recorder.jumped(TICKS // 4, flown.jump, TICKS // 4)
        keyframes = iter(flown.keyframes)
        for tick, states in flown.states.items():
            for state in states.values():
                recorder.heard(topics.STATE, state, tick)
            if tick % KEYFRAME_TICKS == 0:
                taken = [next(keyframes) for _ in CAMERAS]
                for keyframe in taken:
                    recorder.heard(topics.KEYFRAME, keyframe, tick)
                recorder.handed_over(tick, taken)
            ids, poses = flown.poses(tick)
            recorder.integrated(Integrated(tick, ids, poses, None))
        if finished:
            recorder.finished(_summary(flown), flown.mesh)
    return path


def _summary(flown: Flown) -> Summary:
    score = Score.of(1.0, 0.5)
    return Summary(
        mission=flown.mission.name,
        seed=flown.mission.seed,
        drones=len(CAMERAS),
        exit_reason="duration",
        final=Metrics(TICKS * flown.mission.tick_s, TICKS, float(flown.phi.mean()), None, 1, len(flown.keyframes)),
        floor_baseline=Scores(score, score, score),
        min_separation_m=1.0,
        fallbacks=dict.fromkeys(CAMERAS, 0),
        wall_time_s=1.0,
        phi_sha256="",
        mesh_sha256=None,
        versions={},
    )
