"""What a map takes is known before the mission flies, is bounded, and does not grow with the mission."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from types import FunctionType, ModuleType

import numpy as np
import pytest

from faults.floor_flight import LEG, MISSION, fly
from ground_station.keyframe_log import KeyframeLog
from ground_station.mapper import Mapper
from ground_station.mesh_blocks import MeshBlocks
from ground_station.reconstruction import plane_sweep_reconstructor
from ground_station.reconstruction.backends import make_reconstructor
from ground_station.reconstruction.memory import MEGABYTE, needs
from protocol.errors import ReconstructionError
from protocol.field import VirtualField
from protocol.map_settings import Camera, Reconstruction
from protocol.messages import Keyframe
from protocol.mission import Mission, Target

VIEWS_KEPT = 24


def mapped(**settings: object) -> Mission:
    return MISSION.model_copy(
        update={"target": Target(), "reconstruction": Reconstruction.model_validate(settings), "camera": Camera()}
    )


def test_a_map_that_needs_more_than_the_limit_is_refused_and_what_takes_it_is_named() -> None:
    with pytest.raises(ReconstructionError) as refused:
        make_reconstructor(mapped(voxel_m=0.008))
    told = str(refused.value)
    assert "memory_limit_mb 2048" in told
    assert told.index("voxels (voxel_m, target)") < told.index("keyframes of 128 x 72 (sweep_width_px)")
    make_reconstructor(mapped(voxel_m=0.025, memory_limit_mb=140))
    with pytest.raises(ReconstructionError, match="memory_limit_mb 120"):
        make_reconstructor(mapped(voxel_m=0.025, memory_limit_mb=120))


def test_mended_poses_and_larger_images_need_more_and_a_map_made_elsewhere_nothing() -> None:
    plain, mended, large = (
        sum(needs(mapped(**settings)).values()) for settings in ({}, {"refine_poses": True}, {"sweep_width_px": 256})
    )
    assert 120 * MEGABYTE < plain < mended
    assert large > plain + 150 * MEGABYTE
    assert needs(mapped(backend="external")) == needs(mapped(backend="none")) == {}


@pytest.fixture
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plane_sweep_reconstructor, "VIEWS_KEPT", VIEWS_KEPT)


def flown(**settings: object) -> Mission:
    chosen = MISSION.reconstruction.model_dump() | {"sweep_width_px": 48, "depth_planes": 16} | settings
    return MISSION.model_copy(update={"reconstruction": Reconstruction.model_validate(chosen)})


def flights(first: int, last: int) -> Iterator[Keyframe]:
    """To and fro, counted from ``first`` to before ``last``."""
    there = fly()
    for number in range(first, last):
        for place, one in enumerate(there if number % 2 else reversed(there)):
            at = number * LEG + place
            yield one.model_copy(update={"sequence": at, "tick": 10 * at})


def held(root: object) -> tuple[int, int]:
    """How many objects ``root`` keeps alive, and their bytes."""
    found: dict[int, object] = {}
    waiting = [root]
    while waiting:
        one = waiting.pop()
        if id(one) in found or isinstance(one, int | type | ModuleType | FunctionType | Thread):
            continue
        found[id(one)] = one
        waiting += gc.get_referents(one)
        if isinstance(one, np.ndarray) and one.base is not None:
            waiting.append(one.base)
    return len(found), sum(sys.getsizeof(one) for one in found.values())


@pytest.mark.usefixtures("few_views")
@pytest.mark.parametrize("settings", [{}, {"refine_poses": True}], ids=["exact", "refined"])
def test_what_the_ground_stations_map_holds_does_not_grow_with_the_mission(
    settings: dict[str, object], tmp_path: Path
) -> None:
    mission = flown(**settings)
    with KeyframeLog(tmp_path / "keyframes") as log:
        mapper, blocks = Mapper(mission, VirtualField.of(mission.target), tmp_path, log), MeshBlocks()
        sizes = []
        for first, last in ((0, 10), (10, 30)):
            for keyframe in flights(first, last):
                mapper.add([keyframe])
                if keyframe.sequence % LEG == 0:
                    blocks.update(mapper.update(scored=False).mesh)
                    mapper.state()
            gc.collect()
            sizes.append(held([mapper, blocks]))
        assert log.count == 30 * LEG
        assert mapper.statistics.received > 10 * VIEWS_KEPT
        parts = needs(mission)
        lasting = sum(size for name, size in parts.items() if "threads" not in name and "extracting" not in name)
        assert mapper.statistics.memory_bytes == lasting, "what was said to be needed is what is there"
    (objects, size), (objects_later, size_later) = sizes
    assert objects > 100
    assert objects_later - objects < 0.1 * 20 * LEG
    assert size_later < 1.01 * size
