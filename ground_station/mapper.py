"""The slow half of the ground station: images in, map out. One worker thread owns it, and the event loop is free."""

from __future__ import annotations

import io
import itertools
import logging
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ground_station.evaluation import FULL_SAMPLES, LIVE_SAMPLES, Scores, Truth, floor_baseline, load_truth, score
from ground_station.external_map import ExternalMap
from ground_station.keyframe_log import KeyframeStore
from ground_station.mesh_change_choice import make_mesh_change
from ground_station.reconstruction.backends import make_reconstructor
from ground_station.reconstruction.reconstructor import Keyframe, Mesh, State, Statistics
from protocol import messages
from protocol.depth_image import decode_depth
from protocol.errors import MessageError, ReconstructionError
from protocol.field import VirtualField
from protocol.geometry import Intrinsics
from protocol.keyframe_rule import KeyframeRule
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """The map at one tick and what it says."""

    mesh: Mesh
    change: NDArray[np.float32]
    """h2 (positions,), against the update before."""
    scores: Scores | None
    """None when not asked for, or when no truth is known."""


@dataclass(frozen=True, slots=True, eq=False)
class MapState:
    """The map at one moment, for a checkpoint."""

    reconstruction: State
    first: int
    """Position in the keyframe log from which the reconstructor needs to see keyframes again ..."""
    end: int
    """... and from which on they are not in this map."""
    unreadable: int
    """Part of `Mapper.refused` ..."""
    unlocated: int = 0
    """... likewise."""


class Mapper:
    """Not thread-safe on purpose: all calls come from one worker."""

    def __init__(
        self,
        mission: Mission,
        field: VirtualField,
        run: Path,
        keyframes: KeyframeStore,
        external: ExternalMap | None = None,
    ) -> None:
        """``run`` is where the truth is looked for, ``keyframes`` where all that are added are kept; ``external`` as
        for `make_reconstructor`."""
        self._mission, self._run, self._log = mission, run, keyframes
        self._rules: dict[int, KeyframeRule] = {}
        self._reconstructor = make_reconstructor(mission, external)
        self._change = make_mesh_change(mission, field)
        self._truth: Truth | None = None
        self._recent: deque[int] = deque(maxlen=self._reconstructor.lookback)
        self._unreadable = 0
        self.unlocated = 0
        """Those of `refused` whose drone did not know well enough where it was."""
        self._compared, self._comparing_s = 0, 0.0
        self.refused = 0
        """Images or poses that could not be read, or that the reconstructor cannot use."""
        self.memory_bytes = 0
        """Of map and mesh at the last update."""

    def keep(self, keyframes: Sequence[messages.Keyframe]) -> None:
        """Only log keyframes for which there is no time now: a map that is made from the log will have them."""
        for message in keyframes:
            self._log.append(message)

    def add(self, keyframes: Sequence[messages.Keyframe]) -> None:
        """Take in keyframes in order; what cannot be used is counted and said, and the mission goes on."""
        for message in keyframes:
            self._recent.append(self._log.end)
            self._log.append(message)
        self._map(keyframes)

    def _map(self, keyframes: Sequence[messages.Keyframe]) -> None:
        readable = (self._read(message) for message in keyframes)
        self._reconstructor.add([keyframe for keyframe in readable if keyframe is not None])
        self._count_refused()

    def _count_refused(self) -> None:
        self.refused = self._unreadable + self.unlocated + sum(self._reconstructor.statistics().refused.values())

    def _read(self, message: messages.Keyframe) -> Keyframe | None:
        """The keyframe in ``message``; None if it cannot be read, its pose is too bad, or the camera hardly moved since
        the last."""
        settings = self._mission.localization
        if (
            message.position_sd_m > settings.keyframe_deviation_max_m
            or message.angle_sd_rad > settings.keyframe_deviation_max_rad
        ):
            self.unlocated += 1
            return None
        try:
            keyframe = read_keyframe(message)
        except (ReconstructionError, MessageError, UnidentifiedImageError, OSError, ValueError) as error:
            self._unreadable += 1
            log.warning("drone %d: keyframe %d refused: %s", message.drone, message.sequence, error)
            return None
        rule = self._rules.setdefault(keyframe.drone, KeyframeRule(self._mission.camera))
        return keyframe if rule.wants(keyframe.position, keyframe.rotation) else None

    @property
    def taken(self) -> int:
        """Keyframes that the log holds: all since the start of the mission, also from before a restart."""
        return self._log.count

    def update(self, *, scored: bool) -> MapUpdate:
        """The mesh of all that is fused by now, and where it changed."""
        mesh = self._reconstructor.mesh()
        self.memory_bytes = self.statistics.memory_bytes + mesh.size_bytes
        began_s = time.perf_counter()
        change = self._change.update(mesh)
        self._comparing_s += time.perf_counter() - began_s
        self._compared += 1
        return MapUpdate(mesh, change, self._score(mesh, LIVE_SAMPLES) if scored else None)

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        """Which cells of ``grid`` were seen free by now."""
        return self._reconstructor.free_cells(grid)

    @property
    def feedback_update_s(self) -> float | None:
        """Mean wall time of one update of the feedback, two meshes to h2; None when there was none."""
        feeds_back = self._mission.feedback.method != "none"
        return self._comparing_s / self._compared if feeds_back and self._compared else None

    def finish(self, *, scored: bool = True) -> MapUpdate:
        """The last mesh, with what still waited for later views, scored in full."""
        self._reconstructor.flush()
        mesh = self._reconstructor.mesh()
        self._count_refused()
        return MapUpdate(mesh, self._change.update(mesh), self._score(mesh, FULL_SAMPLES) if scored else None)

    @property
    def statistics(self) -> Statistics:
        """The reconstructor's."""
        return self._reconstructor.statistics()

    def floor_scores(self) -> Scores | None:
        """What nothing but a bare floor scores here."""
        return floor_baseline(self._truth, self._mission.target) if self._truth else None

    def state(self) -> MapState:
        """For a checkpoint; nothing of it changes any more.

        Raises:
            StorageError: the disk refused keyframes that it speaks of.
        """
        self._log.sync()
        end = self._log.end
        first = self._recent[0] if self._recent else end
        return MapState(self._reconstructor.state(), first, end, self._unreadable, self.unlocated)

    def restore(self, state: MapState | None) -> int:
        """In a new mapper: the map as it was at the checkpoint, then the keyframes that the log has from after it.

        Without a checkpoint, the whole map anew from the log, some ten milliseconds a keyframe. The next update's
        change is against this map: what led to jumps before does not lead to them again. Returns how many keyframes
        were mapped again.

        Raises:
            ReconstructionError: the state is another mission's.
        """
        if state is not None:
            self._reconstructor.restore(state.reconstruction, self._known(state))
            self._unreadable, self.unlocated = state.unreadable, state.unlocated
        count = 0
        later = self._log.read(state.end if state else 0, self._log.end)
        for _, group in itertools.groupby(later, key=lambda found: found[1].tick):
            positions, keyframes = zip(*group, strict=True)
            self._recent.extend(positions)
            self._map(keyframes)
            count += len(keyframes)
        self.update(scored=False)
        return count

    def _known(self, state: MapState) -> Iterator[Keyframe]:
        for position, message in self._log.read(state.first, state.end):
            self._recent.append(position)
            keyframe = self._read(message)
            if keyframe is not None:
                yield keyframe

    def _score(self, mesh: Mesh, samples: int) -> Scores | None:
        if self._truth is None:
            self._truth = load_truth(self._run)
        if self._truth is None:
            return None
        return score(mesh.vertices, mesh.faces, self._truth, self._mission.target, samples=samples)


def read_keyframe(message: messages.Keyframe) -> Keyframe:
    """What ``message`` shows.

    Raises:
        ReconstructionError: image, depth or pose are impossible.
        MessageError: its depth cannot be read.
        OSError, ValueError: likewise its image.
    """
    with Image.open(io.BytesIO(message.jpeg), formats=["JPEG"]) as image:
        if image.size != (message.width, message.height):
            raise ReconstructionError(f"image is {image.size}, its message says {(message.width, message.height)}")
        pixels = np.asarray(image.convert("RGB"))
    return Keyframe(
        drone=message.drone,
        sequence=message.sequence,
        tick=message.tick,
        image=pixels,
        position=np.array(message.position),
        rotation=np.array(message.rotation),
        intrinsics=Intrinsics(message.width, message.height, message.fx, message.fy, message.cx, message.cy),
        depth=decode_depth(message.depth, message.width, message.height) if message.depth else None,
    )
