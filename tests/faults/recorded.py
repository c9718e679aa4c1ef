"""A made-up flight for recorders, and a process that records one until it is killed: python -m faults.recorded FILE."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.recorder import Recorder
from ground_station.results import Metrics, Summary
from protocol import messages, topics
from protocol.field import VirtualField
from protocol.mission import Drone, Mission
from protocol.obstacle_grid import ObstacleGrid
from protocol.replication import Integrated

KEYFRAME_TICKS = 10
LOOK_TICKS = 40


def team(drones: int = 2) -> Mission:
    places = ((1.5 * number - 3, 0.0, 2.0, 0.0, 1.5) for number in range(1, drones + 1))
    return Mission(name="recorded", drones=tuple(Drone(id=i, start=start) for i, start in enumerate(places, 1)))


def state(drone: int, tick: int, *, random: np.random.Generator) -> messages.DroneState:
    """Numbers that no short decimal fraction holds."""
    x, y, z, *rest = random.standard_normal(5).tolist()
    pose = (x, y, z, *rest)
    replica = messages.ReplicaState(tick=tick, epoch=1, next_jump=0, missing=0, repaired=0, lost=0)
    control = messages.Control(
        tick=tick, outcome="solved", velocity=pose, slack=x, sampling=y, solve_s=1e-3, separation_margin_m2=z,
        region_margin_m=x, pitch_margin_rad2=y, active=("separation 2",), fallbacks=0, refused=0,
    )  # fmt: skip
    return messages.DroneState(
        drone=drone, tick=tick, pose=pose, velocity=pose, battery=0.5, mode="flying", earlier=((tick, pose),),
        importance=0.25, replica=replica, control=control,
    )  # fmt: skip


def keyframe(
    drone: int, sequence: int, tick: int, *, random: np.random.Generator, size: int = 200
) -> messages.Keyframe:
    x, y, z = random.standard_normal(3).tolist()
    return messages.Keyframe(
        drone=drone, sequence=sequence, tick=tick, position=(x, y, z), rotation=((x, y, z), (y, z, x), (z, x, y)),
        width=64, height=48, fx=50.1, fy=49.9, cx=32.0, cy=24.0, jpeg=b"\xff\xd8" + random.bytes(size),
    )  # fmt: skip


def a_mesh(random: np.random.Generator, triangles: int = 4) -> Mesh:
    vertices = random.standard_normal((triangles + 2, 3)).astype(np.float32)
    faces = (np.arange(triangles)[:, None] + np.arange(3)).astype(np.int32)
    return Mesh(vertices, faces, random.integers(0, 255, (triangles + 2, 3), dtype=np.uint8))


class Flight:
    """What was given to a recorder, in order."""

    def __init__(self, mission: Mission, seed: int = 1) -> None:
        self.mission = mission
        self.random = np.random.default_rng(seed)
        self.drones = [drone.id for drone in mission.drones]
        self.inputs: list[messages.Keyframe | Sequence[messages.Keyframe] | Integrated | messages.Jump | float] = []
        self.states: list[messages.DroneState] = []
        self.keyframes: list[messages.Keyframe] = []
        self.meshes: list[Mesh] = []
        self.offered: Counter[str] = Counter({"/mission": 1})
        """Messages of each channel."""
        self._waiting: list[messages.Keyframe] = []
        self._shape = VirtualField.of(mission.target).shape

    def fly(self, recorder: Recorder, ticks: range) -> None:
        for tick in ticks:
            self._tick(recorder, tick)

    def _tick(self, recorder: Recorder, tick: int) -> None:
        if self._waiting:
            recorder.handed_over(tick, self._waiting)
            self._note(tuple(self._waiting), "/ground/hand_over")
            self._waiting = []
        for drone in self.drones:
            told = state(drone, tick, random=self.random)
            recorder.heard(topics.STATE, told, tick)
            self.states.append(told)
            self.offered.update(["/tf", f"/drone/{drone}/pose", f"/drone/{drone}/state"])
            if tick % KEYFRAME_TICKS == 0:
                taken = keyframe(drone, tick // KEYFRAME_TICKS, tick, random=self.random)
                recorder.heard(topics.KEYFRAME, taken, tick)
                self._waiting.insert(0, taken)  # the map's order need not be that of arrival
                self.keyframes.append(taken)
                self.offered.update(f"/drone/{drone}/{part}" for part in ("calibration", "camera", "keyframe"))
        poses = self.random.standard_normal((len(self.drones), 5))
        step = Integrated(tick, list(self.drones), poses, None)
        recorder.integrated(step)
        self._note(step, "/ground/integrated")
        if tick % LOOK_TICKS == 0:
            importance = float(self.random.random())
            recorder.looked(tick, importance)
            self._note(importance, "/ground/look")
            increments = self.random.random(self._shape[0], dtype=np.float32)
            jump = messages.Jump(epoch=7, sequence=tick // LOOK_TICKS, tick=tick + 20, increments=increments)
            recorder.jumped(tick, jump, tick)
            self._note(jump, "/phi/jump")
        event = messages.Event(source="drone/1", tick=tick, level="warning", kind="mode", text=f"tick {tick}")
        recorder.heard(topics.EVENT, event, tick)
        self.offered.update(["/log", "/event"])
        recorder.metrics(self._metrics(tick))
        self.offered.update(["/ground/metrics"])

    def finish(self, recorder: Recorder, tick: int) -> None:
        self.meshes.append(a_mesh(self.random))
        summary = Summary(
            mission="recorded", seed=1, drones=len(self.drones), exit_reason="enough", final=self._metrics(tick),
            floor_baseline=None, min_separation_m=1.0, fallbacks={1: 0}, wall_time_s=1.0, phi_sha256="a",
            mesh_sha256="b", versions={},
        )  # fmt: skip
        recorder.finished(summary, self.meshes[-1])
        grid = ObstacleGrid.of(self.mission)
        free = np.ones(grid.shape, np.bool_)
        free[10:16, 20:30, :8] = False
        self.free = grid, free
        recorder.free(tick, *self.free)
        self.offered.update(["/map", "/map/free", "/ground/summary"])

    def _metrics(self, tick: int) -> Metrics:
        time_s = tick * self.mission.tick_s
        return Metrics(time_s=time_s, tick=tick, importance=0.5, scores=None, jumps=0, keyframes=len(self.keyframes))

    def _note(self, entry: tuple[messages.Keyframe, ...] | Integrated | messages.Jump | float, channel: str) -> None:
        self.inputs.append(entry)
        self.offered[channel] += 1


def main() -> None:
    """One drone says twice a second where it is; each line tells the tick that was recorded."""
    mission = team(1)
    random = np.random.default_rng(1)
    with Recorder(Path(sys.argv[1]), mission, lossless=False) as recorder:
        for tick in range(0, 10**6, 10):
            recorder.heard(topics.STATE, state(1, tick, random=random), tick)
            print(tick, flush=True)
            time.sleep(10 * mission.tick_s)


if __name__ == "__main__":
    main()
