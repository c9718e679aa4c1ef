"""A recording as a source of exports: all of a flight in one file, whatever became of the run's folder."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path

from ground_station.export.source import Flight, Importance, Progress, unwatched
from ground_station.mesh_files import read_glb, read_ply
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.entries import IntegratedTick, JumpRecord
from ground_station.recording.reader import Recording
from ground_station.trajectories import Trajectories
from protocol.errors import RecordingError
from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.messages import DroneState, Keyframe
from protocol.replica import Replica

log = logging.getLogger(__name__)


class RecordedSource:
    """See `ground_station.export.source.Source`."""

    def __init__(self, path: Path, progress: Progress = unwatched) -> None:
        """Of one that is cut short, what is whole is read.

        Raises:
            RecordingError: it cannot be read, or is none.
        """
        self.path = path
        self._progress = progress
        self._recording = Recording.open(path, salvage=True)
        self.mission = self._recording.mission
        if not self._recording.complete:
            log.warning("%s: the flight's end is not in it; what there is is exported", path)

    def keyframes(self) -> Iterator[Keyframe]:
        channels = self._recording.counts()
        total = sum(channels.get(f"/drone/{drone.id}/keyframe", 0) for drone in self.mission.drones)
        for number, keyframe in enumerate(self._recording.keyframes(), 1):
            yield keyframe
            self._progress("keyframes", number, total)

    def flight(self) -> Flight:
        drones = sorted(drone.id for drone in self.mission.drones)
        states: dict[int, dict[int, DroneState]] = {}
        for drone in drones:
            for state in self._recording.states(drone):
                states.setdefault(state.tick, {})[drone] = state
        trajectories = Trajectories(drones)
        for tick, heard in sorted(states.items()):
            poses: Mapping[int, tuple[float, ...]] = {drone: state.pose for drone, state in heard.items()}
            trajectories.add(tick, tick * self.mission.tick_s, poses, heard)
        return Flight.of(trajectories.arrays())

    def mesh(self) -> Mesh:
        final = self._recording.final_mesh_ply()
        if final is not None:
            return read_ply(final, f"{self.path}: its final map")
        newest = None
        for tick, content in self._recording.meshes():
            newest = tick, content
        if newest is None:
            raise RecordingError(f"{self.path}: holds no map")
        return read_glb(newest[1], f"{self.path}: its map of {newest[0] * self.mission.tick_s:g} s")

    def importance(self) -> Importance:
        """Made again from what it was made from: every tick's poses, and the jumps."""
        replica = Replica(ImportanceField(VirtualField.of(self.mission.target), self.mission.sensing))
        total = self._recording.counts().get("/ground/integrated", 0)
        for entry in self._recording.inputs():
            match entry:
                case JumpRecord(jump=jump):
                    replica.hear(jump)
                case IntegratedTick(tick=tick, poses=poses):
                    if tick != replica.tick:
                        raise RecordingError(
                            f"{self.path}: phi is known from its beginning on only, and "
                            f"{'ticks are missing' if replica.tick else 'this recording begins'} at tick {tick}"
                        )
                    replica.advance(tick, poses, self.mission.tick_s)
                    self._progress("phi", replica.tick, total)
        if not replica.tick:
            raise RecordingError(f"{self.path}: phi never changed in it")
        moment = f"after {replica.tick * self.mission.tick_s:g} s"
        return Importance(replica.field.field, replica.field.phi, moment)
