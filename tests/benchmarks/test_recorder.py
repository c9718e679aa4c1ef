"""What recording costs four drones in real time: the recorder's share of a core, and how long it holds up a caller."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from faults.recorded import a_mesh, keyframe, state, team
from ground_station.recording.recorder import Recorder
from protocol import topics
from protocol.field import VirtualField
from protocol.replication import Integrated

Record = Callable[..., None]

DRONES = 4
FLIGHT_S = 11.0
"""Of mission time and of wall time; a map at its begin and after ten seconds."""
IMAGES_PER_S = 16
IMAGE_BYTES = (20_000, 80_000)
TRIANGLES = 100_000
CORE_SHARE = 0.1
DISK_BYTES_PER_S = 50 * 2**20


@dataclass(frozen=True)
class Cost:
    calls_s: list[float]
    """How long each call took."""
    late_s: list[float]
    """How late each tick began: a thread that does not let others run would show here."""
    share: float
    """Of a core, that all other threads took."""


def fly(recorder: Recorder) -> Cost:
    mission = team(DRONES)
    random = np.random.default_rng(1)
    drones = [drone.id for drone in mission.drones]
    ticks = round(FLIGHT_S / mission.tick_s)
    image_ticks = round(DRONES / IMAGES_PER_S / mission.tick_s)
    states = [[state(drone, tick, random=random) for drone in drones] for tick in range(ticks)]
    keyframes = {
        tick: [keyframe(i, tick, tick, random=random, size=int(random.integers(*IMAGE_BYTES))) for i in drones]
        for tick in range(0, ticks, image_ticks)
    }
    mesh = a_mesh(random, TRIANGLES)
    phi = random.random(VirtualField.of(mission.target).shape, dtype=np.float32)
    poses = random.standard_normal((DRONES, 5))
    calls_s: list[float] = []
    late_s: list[float] = []

    def call(method: Callable[..., None], *arguments: object) -> None:
        began_s = time.perf_counter()
        method(*arguments)
        calls_s.append(time.perf_counter() - began_s)

    others_s = time.process_time() - time.thread_time()
    begun_s = time.perf_counter()
    for tick in range(ticks):
        due_s = begun_s + tick * mission.tick_s
        time.sleep(max(0.0, due_s - time.perf_counter()))
        late_s.append(time.perf_counter() - due_s)
        for told in states[tick]:
            call(recorder.heard, topics.STATE, told, tick)
        for taken in keyframes.get(tick, []):
            call(recorder.heard, topics.KEYFRAME, taken, tick)
        if tick in keyframes:
            call(recorder.handed_over, tick, keyframes[tick])
        call(recorder.integrated, Integrated(tick, drones, poses, None))
        call(recorder.phi, tick, phi)
        call(recorder.mesh, tick, mesh)
    share = (time.process_time() - time.thread_time() - others_s) / (time.perf_counter() - begun_s)
    return Cost(calls_s, late_s, share)


@pytest.mark.timeout(120)
def test_recorder(tmp_path: Path, record: Record) -> None:
    """Against the same flight without a file: machines that do something else hold up callers as well."""
    mission = team(DRONES)
    with Recorder(None, mission, lossless=False) as recorder:
        without = fly(recorder)
    with Recorder(tmp_path / "recording.mcap", mission, lossless=False) as recorder:
        cost = fly(recorder)
    statistics = recorder.statistics()
    assert statistics.written["/map"] == 2
    assert not any(statistics.dropped.values())
    record("recorder_core_share", 100 * cost.share, "% of a core", "a tenth of a core", CORE_SHARE / cost.share)
    for name, quantile in (("p99", 99), ("worst", 100)):
        for what, measured, base in (
            ("stall", cost.calls_s, without.calls_s),
            ("tick_late", cost.late_s, without.late_s),
        ):
            found, compared = np.percentile(measured, quantile), np.percentile(base, quantile)
            record(f"recorder_{what}_{name}", 1e3 * found, "ms", "no recording", compared / found)
    rate = statistics.bytes / FLIGHT_S
    record("recorder_file", rate / 2**20, "MiB/s", "a disk of 50 MiB/s", DISK_BYTES_PER_S / rate)
