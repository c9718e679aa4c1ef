"""The slow half of the ground station: images in, map out. One worker thread owns it, and the event loop is free."""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ground_station.evaluation import FULL_SAMPLES, LIVE_SAMPLES, Scores, Truth, floor_baseline, load_truth, score
from ground_station.mesh_change import GridMeshChange
from ground_station.reconstruction.backends import make_reconstructor
from ground_station.reconstruction.reconstructor import Keyframe, Mesh
from protocol import messages
from protocol.errors import ReconstructionError
from protocol.field import VirtualField
from protocol.geometry import Intrinsics
from protocol.keyframe_rule import KeyframeRule
from protocol.mission import Mission

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """The map at one tick and what it says."""

    mesh: Mesh
    change: NDArray[np.float32]
    """h2 (positions,), against the update before."""
    scores: Scores | None
    """None when not asked for, or when no truth is known."""


class Mapper:
    """Not thread-safe on purpose: all calls come from one worker."""

    def __init__(self, mission: Mission, field: VirtualField, run: Path) -> None:
        self._mission, self._run = mission, run
        self._rules: dict[int, KeyframeRule] = {}
        self._reconstructor = make_reconstructor(mission)
        self._change = GridMeshChange(mission.target, mission.feedback, (field.xs, field.ys, field.zs))
        self._truth: Truth | None = None
        self.refused = 0
        """Images or poses that could not be read, or that the reconstructor cannot use."""

    def add(self, keyframes: Sequence[messages.Keyframe]) -> None:
        """Take in keyframes in order; what cannot be used is counted and said, and the mission goes on."""
        readable = []
        for message in keyframes:
            try:
                keyframe = _decode(message)
            except (ReconstructionError, UnidentifiedImageError, OSError, ValueError) as error:
                self.refused += 1
                log.warning("drone %d: keyframe %d refused: %s", message.drone, message.sequence, error)
                continue
            rule = self._rules.setdefault(keyframe.drone, KeyframeRule(self._mission.camera))
            if rule.wants(keyframe.position, keyframe.rotation):
                readable.append(keyframe)
        outcomes = self._reconstructor.add(readable)
        self.refused += sum(outcome.state == "refused" for outcome in outcomes)

    def update(self, *, scored: bool) -> MapUpdate:
        """The mesh of all that is fused by now, and where it changed."""
        mesh = self._reconstructor.mesh()
        return MapUpdate(mesh, self._change.update(mesh.vertices), self._score(mesh, LIVE_SAMPLES) if scored else None)

    def finish(self) -> MapUpdate:
        """The last mesh, with what still waited for later views, scored in full."""
        self._reconstructor.flush()
        mesh = self._reconstructor.mesh()
        return MapUpdate(mesh, self._change.update(mesh.vertices), self._score(mesh, FULL_SAMPLES))

    def floor_scores(self) -> Scores | None:
        """What nothing but a bare floor scores here."""
        return floor_baseline(self._truth, self._mission.target) if self._truth else None

    def _score(self, mesh: Mesh, samples: int) -> Scores | None:
        if self._truth is None:
            self._truth = load_truth(self._run)
        if self._truth is None:
            return None
        return score(mesh.vertices, mesh.faces, self._truth, self._mission.target, samples=samples)


def _decode(message: messages.Keyframe) -> Keyframe:
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
    )
