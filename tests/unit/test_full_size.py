"""The field of 1.5e7 cells that the paper prints: 60 MB of phi, which no process may hold often or send at once."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from ground_station.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from ground_station.export.importance_files import vtk, write_npz
from ground_station.export.source import Importance
from ground_station.mapper import MapState
from ground_station.recording.recorder import Recorder
from ground_station.results import RunFolder
from protocol.messages import DroneState, Jump, JumpHead, PhiDigest, PhiPage, ReplicaState, Tick
from protocol.mission import Mission
from protocol.mission_file import load_mission
from protocol.replication import BlocksRequest, Replication
from protocol.wire import decode, encode

MISSION = load_mission(Path(__file__).parents[2] / "missions" / "paper-full.toml", drones=2)
CELLS = 14_976_000
PHI_BYTES = 4 * CELLS
SMALL_BYTES = PHI_BYTES // 5
LIMIT_BYTES = 200_000_000
"""Of phi in any process, all copies together."""
UNCUT_BYTES = 65_535
"""Longer messages are cut by zenoh, and did not come through narrow links."""
EPOCH = 5
NOBODY: frozenset[str] = frozenset()
PAGES_A_TICK = 400


def states(tick: int) -> Iterator[DroneState]:
    replica = ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0)
    for drone in (1, 2):
        pose = (1.5 * drone - 2, 0.04 * tick - 1, 1.6, 0.1 * tick, 1.3)
        yield DroneState(
            drone=drone, tick=tick, pose=pose, velocity=(0.0,) * 5, battery=1.0, mode="flying", importance=1.0,
            replica=replica, control=None,
        )  # fmt: skip


def jump(sequence: int, tick: int) -> Jump:
    increments = np.random.default_rng(sequence).uniform(0, 0.5, 72_000).astype(np.float32)
    return Jump(epoch=EPOCH, sequence=sequence, tick=tick, increments=increments)


def integrate(tick: int, replications: list[Replication]) -> None:
    beat = Tick(
        tick=tick, time_s=tick * 0.05, lockstep=False, live=(1, 2), vehicles=(), jump_epoch=0, next_jump=0, keyframes=0
    )
    for replication in replications:
        replication.hear_tick(beat)
        for state in states(tick):
            replication.hear_state(state)
        replication.hear_head(JumpHead(epoch=EPOCH, next_sequence=0, done=tick + 7, phase="flying"))
        replication.integrate(tick, NOBODY, 0)


@pytest.fixture
def ground() -> Replication:
    return Replication(MISSION, authority=True, epoch=EPOCH)


def peak_bytes(action: Callable[[], object]) -> int:
    """Most memory that ``action`` held at once, beyond what there was."""
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_one_that_joins_late_fetches_phi_in_pages_and_ends_in_the_same_bytes(ground: Replication) -> None:
    """The team flies on meanwhile, and phi jumps."""
    late = Replication(MISSION, 2)
    ground.hear_jump(jump(0, tick=2))
    for tick in range(4):
        integrate(tick, [ground])
    tick, longest, pages = 4, 0, 0
    while not late.whole:
        if tick == 6:
            for replication in (ground, late):
                replication.hear_jump(jump(1, tick=8))
        integrate(tick, [ground, late])
        tick += 1
        for _ in range(PAGES_A_TICK):
            request = late.wants()
            if not (isinstance(request, BlocksRequest) and request.tick <= ground.replica.tick):
                break
            sent = encode(ground.page(list(request.blocks)))
            longest, pages = max(longest, len(sent)), pages + 1
            late.hear_page(decode(PhiPage, sent))

    assert ground.replica.field.field.size == CELLS
    assert pages == 2250
    assert longest < UNCUT_BYTES
    assert late.replica.jumps.taken == ground.replica.jumps.taken == 2
    assert late.replica.field.phi.tobytes() == ground.replica.field.phi.tobytes()
    assert late.replica.field.phi.std() > 0.1


def test_a_page_is_carried_forward_without_a_copy_of_the_field(ground: Replication) -> None:
    for tick in range(3):
        integrate(tick, [ground])
    page = ground.page([70])
    for tick in range(3, 6):
        integrate(tick, [ground])
    before = ground.replica.field.phi.tobytes()
    ground.replica.field.phi[70 * 32 : 71 * 32] = 0.0

    assert peak_bytes(lambda: ground.replica.place(page)) < SMALL_BYTES
    assert ground.replica.field.phi.tobytes() == before


def test_whatever_drifted_is_found_within_a_period_by_digests_that_each_travel_whole(ground: Replication) -> None:
    drifted = Replication(MISSION, 1)
    places = np.random.default_rng(3).choice(72_000, 6, replace=False)
    drifted.replica.field.phi[places, 5] += np.float32(0.1)
    told: list[PhiDigest] = []
    for tick in range(20):
        integrate(tick, [ground, drifted])
        for digest in ground.take_digests():
            told.append(digest)
            assert len(encode(digest)) < UNCUT_BYTES
            drifted.hear_digest(digest)

    assert len({digest.tick for digest in told}) == len(told) == 15
    request = drifted.wants()
    found = set()
    while isinstance(request, BlocksRequest):
        page = ground.page(list(request.blocks))
        found |= set(page.blocks.tolist())
        drifted.hear_page(page)
        request = drifted.wants()
    assert found == {int(place) // 32 for place in places}
    assert drifted.replica.field.phi.tobytes() == ground.replica.field.phi.tobytes()


@pytest.fixture(scope="module")
def phi() -> np.ndarray:
    return np.random.default_rng(1).random((72_000, 208), dtype=np.float32)


def test_files_of_phi_are_written_without_a_third_copy_of_it(phi: np.ndarray, tmp_path: Path) -> None:
    """Compressed ones are made in memory, and this noise cannot be compressed."""
    importance = Importance(Replication(MISSION).replica.field.field, phi, "now")
    checkpoint = Checkpoint(EPOCH, 1, 0, phi, MapState({}, first=0, end=0, unreadable=0), {"earlier_jumps": 0.0})
    with closing(RunFolder(tmp_path, MISSION)) as run:
        assert PHI_BYTES + peak_bytes(lambda: run.write_phi(phi, importance.field)) < LIMIT_BYTES
    assert peak_bytes(lambda: save_checkpoint(tmp_path, MISSION, checkpoint)) < SMALL_BYTES
    assert PHI_BYTES + peak_bytes(lambda: write_npz(importance, tmp_path / "phi.npz")) < LIMIT_BYTES
    assert peak_bytes(lambda: [len(part) for part in vtk(importance, MISSION.target)]) < SMALL_BYTES


def test_a_recorder_keeps_no_copy_of_phi(phi: np.ndarray, tmp_path: Path) -> None:
    with Recorder(tmp_path / "recording.mcap", MISSION, lossless=False) as recorder:
        assert peak_bytes(lambda: recorder.phi(0, phi)) < SMALL_BYTES
        recorder.close()
        assert recorder.statistics().written["/phi"] == 1


def test_a_checkpoint_is_read_with_one_copy_of_phi(phi: np.ndarray, tmp_path: Path) -> None:
    save_checkpoint(
        tmp_path,
        MISSION,
        Checkpoint(EPOCH, 1, 0, phi, MapState({}, first=0, end=0, unreadable=0), {"earlier_jumps": 0.0}),
    )
    read: list[Checkpoint | None] = []

    assert peak_bytes(lambda: read.append(load_checkpoint(tmp_path, MISSION))) < PHI_BYTES + SMALL_BYTES
    assert read[0] is not None
    assert read[0].phi.tobytes() == phi.tobytes()


def test_phi_that_was_kept_is_taken_up_without_another_copy(phi: np.ndarray, ground: Replication) -> None:
    assert peak_bytes(lambda: ground.restore(phi, 0)) < SMALL_BYTES
    assert ground.replica.field.importance == pytest.approx(phi.mean(dtype=np.float64), abs=1e-9)


def test_a_jump_costs_no_copy_of_phi(ground: Replication) -> None:
    increments = jump(0, tick=0).increments
    ground.replica.field.jump(increments)

    assert peak_bytes(lambda: ground.replica.field.jump(increments)) < SMALL_BYTES
    assert ground.replica.field.importance == pytest.approx(1 + 2 * increments.mean(dtype=np.float64), abs=1e-6)


def test_the_mission_is_the_papers_but_for_its_cells() -> None:
    paper = load_mission(Path(__file__).parents[2] / "missions" / "paper.toml", drones=2)
    assert isinstance(paper, Mission)
    cells = {"cell_m": MISSION.target.cell_m, "cell_rad": MISSION.target.cell_rad}
    same = paper.model_copy(update={"name": MISSION.name, "target": paper.target.model_copy(update=cells)})
    assert same == MISSION
