"""How fast images become a map, and what it takes of the memory: on rendered flights of four drones through a room."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from faults.measure import cpu_s, median_s
from faults.plain_sweep import plain_costs
from faults.room_flight import rendered, room_mission
from ground_station.keyframe_log import KeyframeLog, NoKeyframes
from ground_station.mapper import Mapper, read_keyframe
from ground_station.mesh_blocks import MeshBlocks
from ground_station.reconstruction.depth_map import planes
from ground_station.reconstruction.plane_sweep import PlaneSweep
from ground_station.reconstruction.plane_sweep_reconstructor import PlaneSweepReconstructor
from ground_station.reconstruction.surface_nets import extract_mesh
from ground_station.reconstruction.views import View, shrink, to_grey
from protocol.field import VirtualField
from protocol.messages import Keyframe
from protocol.mission import Mission

Record = Callable[..., None]

DRONES = 4
EACH = 40
"""Keyframes of each drone."""
COMPILED = 48
"""The first are not timed: numba compiles, and there is little to compare with."""
CORES = len(os.sched_getaffinity(0))
FAST: dict[str, object] = {}
"""128 x 72, the default."""
QUALITY: dict[str, object] = {"sweep_width_px": 160, "depth_planes": 64, "sources": 5}
FUSED_BAR_S = 0.15
MESH_BAR_S = 0.1
LONG = 5000
"""Keyframes of a long mission, and ..."""
SETTLED = 1000
"""... from which on its memory is watched."""
MEGABYTE = 1e6


@pytest.fixture(scope="module")
def flight() -> list[Keyframe]:
    return rendered(room_mission(DRONES), EACH)


def mapper_of(mission: Mission, folder: Path) -> Mapper:
    return Mapper(mission, VirtualField.of(mission.target), folder, NoKeyframes())


@pytest.fixture(scope="module")
def mapped(flight: list[Keyframe]) -> Callable[..., PlaneSweepReconstructor]:
    def build(**settings: object) -> PlaneSweepReconstructor:
        reconstructor = PlaneSweepReconstructor(room_mission(DRONES, workers=CORES, **settings))
        for keyframe in flight:
            reconstructor.add([read_keyframe(keyframe)])
        reconstructor.flush()
        return reconstructor

    return build


@pytest.mark.parametrize(("name", "settings"), [("fast", FAST), ("quality", QUALITY)])
def test_image_to_fused(
    record: Record, flight: list[Keyframe], tmp_path: Path, name: str, settings: dict[str, object]
) -> None:
    """CPU of decoding one keyframe and computing, confirming and fusing a depth map: each call does one of each."""
    mapper = mapper_of(room_mission(DRONES, workers=1, **settings), tmp_path)

    def take(keyframe: Keyframe) -> None:
        mapper.add([keyframe])
        mapper._reconstructor._pool.submit(int).result()  # type: ignore[attr-defined]  # after the depth maps begun

    for keyframe in flight[:COMPILED]:
        take(keyframe)
    rest: Iterator[Keyframe] = iter(flight[COMPILED:])
    times = cpu_s(lambda: take(next(rest)), len(flight) - COMPILED)
    assert mapper.statistics.fused > 0.5 * len(flight)
    for percent in (50, 95):
        took = float(np.percentile(times, percent))
        record(f"image_to_fused_{name}_p{percent}", took * 1e3, "ms CPU", "a bar of 150 ms", FUSED_BAR_S / took)


@pytest.mark.parametrize(("name", "settings", "bar"), [("fast", FAST, 20.0), ("quality", QUALITY, 10.0)])
def test_keyframes_sustained(
    record: Record, flight: list[Keyframe], tmp_path: Path, name: str, settings: dict[str, object], bar: float
) -> None:
    """Wall time of the whole map, on all cores there are: other programs on them count."""
    mapper = mapper_of(room_mission(DRONES, workers=CORES, **settings), tmp_path)
    together = [flight[start : start + DRONES] for start in range(0, len(flight), DRONES)]
    for keyframes in together[: COMPILED // DRONES]:
        mapper.add(keyframes)
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    for keyframes in together[COMPILED // DRONES :]:
        mapper.add(keyframes)
    mapper.finish(scored=False)
    count = len(flight) - COMPILED
    rate = count / (time.perf_counter() - began_s)
    cores = f"{CORES} cores" if CORES > 1 else "a core"
    record(f"keyframes_sustained_{name}", rate, "keyframes / wall s", f"{bar:g} a second on {cores}", rate / bar)
    took_s = (time.process_time() - began_cpu_s) / count
    record(f"keyframe_cpu_{name}", took_s * 1e3, "ms CPU", f"{CORES} / {bar:g} s of all cores", CORES / bar / took_s)


@pytest.mark.parametrize(("name", "settings"), [("fast", FAST), ("quality", QUALITY)])
def test_plane_sweep(record: Record, flight: list[Keyframe], name: str, settings: dict[str, object]) -> None:
    """The matching costs of one keyframe, against whole images in NumPy; the costs are the same."""
    mission = room_mission(DRONES, **settings)
    camera, count = mission.sweep_intrinsics(), mission.reconstruction.depth_planes
    views = []
    for keyframe in (read_keyframe(one) for one in flight[: DRONES * 9 : DRONES]):
        grey = to_grey(shrink(keyframe.image, camera.width, camera.height))
        views.append(View(grey, keyframe.position, keyframe.rotation, camera))
    reference, sources = views[4], [views[place] for place in (3, 5, 2, 6, 1)][: mission.reconstruction.sources]
    depths = planes(0.6, 2.4, count)
    sweep = PlaneSweep(camera.width, camera.height, len(sources), count)
    difference = np.abs(sweep.costs(reference, sources, depths).astype(int) - plain_costs(reference, sources, depths))
    assert np.mean(difference <= 1) > 0.995
    took = median_s(lambda: sweep.costs(reference, sources, depths), 9)
    plainly = median_s(lambda: plain_costs(reference, sources, depths), 3)
    record(f"plane_sweep_{name}", took * 1e3, "ms CPU", "NumPy over whole images", plainly / took)


@pytest.mark.parametrize("voxel_mm", [25, 15])
def test_mesh(record: Record, mapped: Callable[..., PlaneSweepReconstructor], voxel_mm: int) -> None:
    """The whole box meshed, and cut into the blocks that changed, as for whoever watches."""
    volume = mapped(voxel_m=voxel_mm / 1e3)._volume
    before, after = extract_mesh(volume, 1.0), extract_mesh(volume, 0.3)
    assert len(after.faces) > 50_000
    took = median_s(lambda: extract_mesh(volume, 0.3), 5)
    record(f"mesh_{voxel_mm}mm", took * 1e3, "ms CPU", "a bar of 100 ms", MESH_BAR_S / took)
    blocks = MeshBlocks()
    blocks.update(before)
    meshes = iter([after, before] * 3)
    cut = median_s(lambda: blocks.update(next(meshes)), 6)
    record(f"mesh_blocks_{voxel_mm}mm", (took + cut) * 1e3, "ms CPU", "a bar of 100 ms", MESH_BAR_S / (took + cut))


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def over(flight: Sequence[Keyframe], count: int) -> Iterator[list[Keyframe]]:
    """The flight again and again, to and fro: keyframes of one tick together."""
    together = [flight[start : start + DRONES] for start in range(0, len(flight), DRONES)]
    for number in range(count // DRONES):
        lap, place = divmod(number, len(together))
        keyframes = together[place if lap % 2 == 0 else -1 - place]
        yield [one.model_copy(update={"sequence": number, "tick": 5 * number}) for one in keyframes]


@pytest.mark.timeout(900)
def test_memory_of_a_long_mission(record: Record, flight: list[Keyframe], tmp_path: Path) -> None:
    """Resident memory while 5000 keyframes come, are logged and mapped, with meshes, blocks and states."""
    mission = room_mission(DRONES, depth_planes=16)  # what is kept of a keyframe does not depend on it
    with KeyframeLog(tmp_path / "keyframes") as log:
        mapper, blocks = Mapper(mission, VirtualField.of(mission.target), tmp_path, log), MeshBlocks()
        settled, peak = 0, 0
        for keyframes in over(flight, LONG):
            mapper.add(keyframes)
            if log.count % (8 * DRONES) == 0:
                blocks.update(mapper.update(scored=False).mesh)
            if log.count % (80 * DRONES) == 0:
                mapper.state()
            if log.count >= SETTLED:
                settled, peak = settled or resident_bytes(), max(peak, resident_bytes())
        assert log.count == LONG
        assert mapper.statistics.received > 0.9 * LONG
    limit_mb = mission.reconstruction.memory_limit_mb
    taken_mb = mapper.memory_bytes / MEGABYTE
    record("memory_map_5000", taken_mb, "MB", f"limit of {limit_mb:g} MB", limit_mb / taken_mb)
    growth_mb = max((peak - settled) / MEGABYTE, 1.0)
    record("memory_map_growth_5000", growth_mb, "MB after the first 1000", f"{limit_mb:g} MB", limit_mb / growth_mb)
