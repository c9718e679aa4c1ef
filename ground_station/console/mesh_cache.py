"""The map as the console knows it, and what is to be drawn anew when a page of it comes in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from protocol.messages import MeshBlock, MeshPage

Key: TypeAlias = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Redraw:
    draw: tuple[MeshBlock, ...]
    """New or changed, ascending by key."""
    remove: tuple[Key, ...]
    """Drawn before and gone now, ascending."""
    complete: bool
    """False: ask again at once."""


class MeshCache:
    """Pages come from another process and may be anything: what cannot be drawn is counted and left out."""

    def __init__(self) -> None:
        self.refused = 0
        """Blocks so far that are no mesh."""
        self._epoch = 0
        self._revision = 0
        self._blocks: dict[Key, MeshBlock] = {}

    @property
    def parameters(self) -> str:
        """Of the next query of `topics.MAP`: ``since=120;epoch=7``."""
        return f"since={self._revision};epoch={self._epoch}"

    @property
    def blocks(self) -> Mapping[Key, MeshBlock]:
        """All that have faces."""
        return MappingProxyType(self._blocks)

    def take(self, page: MeshPage) -> Redraw:
        """Put in a page; one of another epoch replaces all. Changes that are known already change nothing."""
        drawn = set(self._blocks)
        if page.epoch != self._epoch:
            self._epoch, self._revision = page.epoch, 0
            self._blocks.clear()
        draw: dict[Key, MeshBlock] = {}
        for block in page.blocks:
            if block.revision <= self._revision:
                continue
            draw.pop(block.key, None)
            self._blocks.pop(block.key, None)
            if not len(block.faces):
                continue
            if not _is_mesh(block):
                self.refused += 1
                continue
            self._blocks[block.key] = draw[block.key] = block
        self._revision = max(self._revision, page.revision)
        return Redraw(
            draw=tuple(draw[key] for key in sorted(draw)),
            remove=tuple(sorted(drawn - self._blocks.keys())),
            complete=page.complete,
        )


def _is_mesh(block: MeshBlock) -> bool:
    """Whether faces refer to vertices that are there: a renderer would read beyond the end."""
    vertices, faces, colours = block.vertices, block.faces, block.colours
    return (
        vertices.dtype == np.float32
        and faces.dtype == np.int32
        and colours.dtype == np.uint8
        and vertices.ndim == faces.ndim == 2
        and vertices.shape[1] == faces.shape[1] == 3
        and colours.shape == vertices.shape
        and bool(faces.min() >= 0)
        and bool(faces.max() < len(vertices))
    )
