"""What turns keyframes into a map, seen from the ground station: the one interface all methods share.

A keyframe is not always used at once: most methods wait for views from further along the path. `Reconstructor.add`
therefore reports two kinds of outcome, of the keyframes just given and of earlier ones whose fate is now known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from protocol.errors import ReconstructionError
from protocol.geometry import Floats, Intrinsics
from protocol.obstacle_grid import Cells, ObstacleGrid

ROTATION_TOLERANCE: Final = 1e-4
"""Largest error of an entry of R R^T: float32 on the wire leaves 1e-6."""

PATIENCE_S: Final = 3.0
"""Mission time after which a hovering drone's last keyframes are used without later ones, by methods that wait."""

Refusal: TypeAlias = Literal[
    "repeated", "featureless", "blurred", "off_target", "no_overlap", "no_depth", "wrong_scale", "unanswered", "pose"
]  # fmt: skip
"""``repeated``: not newer than the drone's last, or the same image again (a frozen camera would ruin the map).
``featureless``: black, white or covered. ``off_target``: looks past the box to be mapped. ``no_overlap``: no other
keyframe shows the same place from a useful angle. ``no_depth``: compared, but no depth that two views agree on.
``wrong_scale``: its depths are all the same multiple of what others measured. ``unanswered``: given to an external
process, of which no map with it came. ``pose``: what it shows is not where its pose puts it, by more than noise
explains (``refine_poses`` alone)."""

State: TypeAlias = Mapping[str, NDArray[Any]]
"""What a reconstructor has to know again after a restart, beside its newest keyframes: arrays of its own choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """Raises `ReconstructionError` if the image or the pose is impossible."""

    drone: int
    sequence: int
    """Counts the drone's keyframes."""
    tick: int
    """Mission tick of the exposure."""
    image: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    position: Floats
    """(3,) m, camera centre, world."""
    rotation: Floats
    """(3, 3), camera to world (`protocol.geometry`)."""
    intrinsics: Intrinsics
    """Of ``image``."""
    depth: NDArray[np.float32] | None = None
    """(h, w) m along the optical axis, 0 where unknown, as a depth camera measured it through the same lens."""

    def __post_init__(self) -> None:
        name = f"keyframe {self.sequence} of drone {self.drone}"
        size = (self.intrinsics.height, self.intrinsics.width, 3)
        if self.image.dtype != np.uint8 or self.image.shape != size:
            raise ReconstructionError(f"{name}: image is {self.image.dtype} {self.image.shape}, expected uint8 {size}")
        if self.position.shape != (3,) or self.rotation.shape != (3, 3):
            raise ReconstructionError(f"{name}: pose has shapes {self.position.shape} and {self.rotation.shape}")
        if not (np.isfinite(self.position).all() and np.isfinite(self.rotation).all()):
            raise ReconstructionError(f"{name}: pose is not finite")
        skew = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if skew > ROTATION_TOLERANCE or np.linalg.det(self.rotation) < 0:
            raise ReconstructionError(f"{name}: rotation is not a right-handed orthonormal matrix")
        if self.depth is not None:
            self._check_depth(name, self.depth)

    def _check_depth(self, name: str, depth: NDArray[np.float32]) -> None:
        if depth.dtype != np.float32 or depth.ndim != 2 or 0 in depth.shape:
            raise ReconstructionError(f"{name}: depth is {depth.dtype} {depth.shape}, expected float32 (h, w)")
        height, width = depth.shape
        if not math.isclose(height, width * self.intrinsics.height / self.intrinsics.width, abs_tol=1.0):
            raise ReconstructionError(f"{name}: depth has {width} x {height} pixels, which is not the image's shape")
        if not np.isfinite(depth).all() or depth.min() < 0:
            raise ReconstructionError(f"{name}: depth is not finite, or negative")


@dataclass(frozen=True, slots=True)
class Outcome:
    drone: int
    sequence: int
    state: Literal["waiting", "fused", "refused"]
    reason: Refusal | None = None
    """Given when refused."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    vertices: NDArray[np.float32]
    """(V, 3) m, world."""
    faces: NDArray[np.int32]
    """(F, 3) vertex numbers, counter-clockwise seen from the front."""
    colors: NDArray[np.uint8]
    """(V, 3) RGB."""

    @property
    def size_bytes(self) -> int:
        return self.vertices.nbytes + self.faces.nbytes + self.colors.nbytes

    @classmethod
    def empty(cls) -> Mesh:
        return cls(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty((0, 3), np.uint8))


@dataclass(frozen=True, slots=True)
class Statistics:
    received: int
    fused: int
    waiting: int
    refused: Mapping[Refusal, int]
    memory_bytes: int
    """Of the map and the keyframes kept."""


class Reconstructor(Protocol):
    """Used from one thread. The mesh is a function of the keyframes given so far and their order, of nothing else."""

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        """Take in keyframes, oldest first; one outcome for each, and one for every earlier one decided since."""
        ...

    def flush(self) -> tuple[Outcome, ...]:
        """Decide all that still wait, with the views there are: the end of the mission, or of a leg."""
        ...

    def mesh(self) -> Mesh:
        """Of all that is decided by now; may be empty. The arrays are the caller's."""
        ...

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        """[x, y, z] cells of ``grid`` that drones may fly in, by what is decided by now: those that were seen free, and
        those that the mission vouches for and in which nothing was seen. These alone where a method cannot tell free
        from unknown. The array is the caller's."""
        ...

    def statistics(self) -> Statistics: ...

    @property
    def lookback(self) -> int:
        """How many of the newest keyframes `restore` needs to see again."""
        ...

    def state(self) -> State:
        """For a checkpoint. The arrays are the caller's."""
        ...

    def restore(self, state: State, recent: Iterable[Keyframe]) -> None:
        """Make a new reconstructor go on where another was: the mesh is the same, and who waited waits again.

        ``recent`` are the newest keyframes, `lookback` of them, that the other was given before ``state`` was taken,
        oldest first. Those that are missing cost views to compare with, and those of them that waited are lost.
        Raises `ReconstructionError` if the state is another mission's.
        """
        ...


class NullReconstructor:
    """Makes no map: missions that only fly."""

    def __init__(self) -> None:
        self._received = 0

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        self._received += len(keyframes)
        return tuple(Outcome(keyframe.drone, keyframe.sequence, "fused") for keyframe in keyframes)

    def flush(self) -> tuple[Outcome, ...]:
        return ()

    def mesh(self) -> Mesh:
        return Mesh.empty()

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        return grid.vouched.copy()

    def statistics(self) -> Statistics:
        return Statistics(self._received, self._received, 0, {}, 0)

    @property
    def lookback(self) -> int:
        return 0

    def state(self) -> State:
        return {"received": np.array(self._received)}

    def restore(self, state: State, recent: Iterable[Keyframe]) -> None:  # noqa: ARG002  # the protocol's
        self._received = int(state["received"])
