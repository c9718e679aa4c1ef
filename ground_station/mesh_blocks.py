"""The map in cubes of the world, so that whoever watches it fetches only what has changed.

Every change of a block gets a number of its own, ascending: a page is cut anywhere between two of them, and the last
number in it says where to go on.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Iterator
from typing import Final, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Mesh
from protocol.messages import MeshBlock, MeshPage

Key: TypeAlias = tuple[int, int, int]

BLOCK_M: Final = 1.0
"""Edge of a cube: a room is some tens of them, and a keyframe changes a few."""
PAGE_BYTES: Final = 2**20
"""Of vertices, faces and colours; a page is packed between two ticks, which this takes some milliseconds of."""
PAGE_BLOCKS: Final = 1000
"""A message has no more than `protocol.wire.MAX_MEMBERS_IN_ALL` members, and a block has some thirty."""
EPOCH_BITS: Final = 48


class MeshBlocks:
    """`update` is called from one thread, `page` from any."""

    def __init__(self, block_m: float = BLOCK_M, epoch: int | None = None) -> None:
        """``epoch``: identity of the numbering; random if not given."""
        self.epoch = secrets.randbits(EPOCH_BITS) if epoch is None else epoch
        self._block_m = block_m
        self._blocks: tuple[MeshBlock, ...] = ()
        """Of each block the newest change, ascending by revision. Replaced as a whole: a page sees one map."""

    @property
    def revision(self) -> int:
        """Of the newest change; 0 before the first."""
        return self._blocks[-1].revision if self._blocks else 0

    def update(self, mesh: Mesh) -> int:
        """Take in the newest map; how many blocks changed. A face belongs to the block where its centre lies."""
        known = {block.key: block for block in self._blocks}
        revision = self.revision
        changed: dict[Key, MeshBlock] = {}
        present: set[Key] = set()
        for key, part in _split(mesh, self._block_m):
            present.add(key)
            if key not in known or not _is_equal(known[key], part):
                revision += 1
                changed[key] = _block(key, revision, part)
        for key in sorted(key for key, block in known.items() if len(block.faces) and key not in present):
            revision += 1
            changed[key] = _block(key, revision, Mesh.empty())
        kept = [block for block in self._blocks if block.key not in changed]
        self._blocks = (*kept, *changed.values())
        return len(changed)

    def page(self, since: int = 0, epoch: int = 0, limit_bytes: int = PAGE_BYTES) -> MeshPage:
        """What changed after revision ``since`` of ``epoch``, of another epoch everything: at least one block if there
        is any, more of them up to ``limit_bytes``. A block without faces has vanished."""
        after = since if epoch == self.epoch else 0
        blocks = self._blocks
        waiting = [block for block in blocks if block.revision > after]
        chosen: list[MeshBlock] = []
        size = 0
        for block in waiting[:PAGE_BLOCKS]:
            size += block.vertices.nbytes + block.faces.nbytes + block.colours.nbytes
            if chosen and size > limit_bytes:
                break
            chosen.append(block)
        newest = blocks[-1].revision if blocks else 0
        return MeshPage(
            epoch=self.epoch,
            revision=chosen[-1].revision if chosen else newest,
            complete=len(chosen) == len(waiting),
            blocks=tuple(chosen),
        )


def _split(mesh: Mesh, block_m: float) -> Iterator[tuple[Key, Mesh]]:
    """The part of ``mesh`` in each cube that has any, ascending by key; vertices at seams are in several parts.

    The parts are views of arrays of all parts.
    """
    if not len(mesh.faces):
        return
    cubes = np.empty((3, len(mesh.faces)), np.int64)
    _find_cubes(mesh.vertices, mesh.faces, np.float32(1 / (3 * block_m)), cubes)
    lows = cubes.min(axis=1)
    numbers = np.ravel_multi_index(tuple(cubes - lows[:, None]), tuple(cubes.max(axis=1) - lows + 1))
    order = np.argsort(numbers.astype(np.min_scalar_type(numbers.max())), kind="stable")  # linear up to 16 bits
    starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
    faces, used, ends = _renumber(mesh.faces, order, starts, len(mesh.vertices))
    vertices, colours = mesh.vertices[used], mesh.colors[used]
    keys = cubes[:, order[starts]].T.tolist()
    for (x, y, z), part, own in zip(keys, np.split(faces, starts[1:]), _slices(ends), strict=True):
        yield (x, y, z), Mesh(vertices[own], part, colours[own])


def _slices(ends: NDArray[np.int64]) -> list[slice]:
    stops = ends.tolist()
    return [slice(start, stop) for start, stop in zip([0, *stops[:-1]], stops, strict=True)]


@njit(cache=True, nogil=True)
def _find_cubes(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], third: np.float32, cubes: NDArray[np.int64]
) -> None:
    """Into ``cubes`` (3, F) the cube of each face's centre; ``third`` is one over three edges of a cube."""
    for k in range(faces.shape[0]):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        for axis in range(3):
            cubes[axis, k] = math.floor((vertices[a, axis] + vertices[b, axis] + vertices[c, axis]) * third)


@njit(cache=True, nogil=True)
def _renumber(
    faces: NDArray[np.int32], order: NDArray[np.int64], starts: NDArray[np.int64], vertices: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
    """Faces in ``order``, each part's vertices numbered from 0 as they are first used, so that the rest of the mesh
    does not matter. Returns (faces (F, 3), vertices used by the parts one after the other, (parts,) where each ends).
    """
    renumbered, used = np.empty_like(faces), np.empty(faces.size, np.int32)
    ends = np.empty(starts.size, np.int64)
    user, place = np.full(vertices, -1, np.int32), np.empty(vertices, np.int32)
    total = 0
    for part in range(starts.size):
        before = total
        stop = starts[part + 1] if part + 1 < starts.size else order.size
        for k in range(starts[part], stop):
            for corner in range(3):
                vertex = faces[order[k], corner]
                if user[vertex] != part:
                    user[vertex], place[vertex] = part, total - before
                    used[total] = vertex
                    total += 1
                renumbered[k, corner] = place[vertex]
        ends[part] = total
    return renumbered, used[:total], ends


def _is_equal(block: MeshBlock, part: Mesh) -> bool:
    return (
        np.array_equal(block.vertices, part.vertices)
        and np.array_equal(block.faces, part.faces)
        and np.array_equal(block.colours, part.colors)
    )


def _block(key: Key, revision: int, part: Mesh) -> MeshBlock:
    """Of copies, which do not keep the whole map alive."""
    return MeshBlock(
        key=key,
        revision=revision,
        vertices=part.vertices.copy(),
        faces=part.faces.copy(),
        colours=part.colors.copy(),
    )
