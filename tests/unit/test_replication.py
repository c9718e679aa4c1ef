"""Whatever is lost, late, doubled or restarted: once messages come through again, every phi is the ground station's."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import MessageError
from protocol.field import VirtualField
from protocol.messages import DroneState, JournalPage, Jump, JumpHead, PhiPage, ReplicaState, Tick
from protocol.mission import Drone, Mission, Target
from protocol.mission import Replication as Settings
from protocol.replication import AHEAD_TICKS, BlocksRequest, JournalRequest, Replication
from protocol.wire import encode

DRONES = (2, 3, 7)
MISSION = Mission(
    target=Target(cell_m=0.5, cell_rad=0.8),
    drones=tuple(Drone(id=drone, start=(1.5 * k - 2, 0.0, 2.0, 0.0, 1.3)) for k, drone in enumerate(DRONES)),
    replication=Settings(digest_period_s=0.5, tolerance=1e-12),  # nothing is small enough to be left
)
POSITIONS = VirtualField.of(MISSION.target).shape[0]
WAIT_TICKS = round(MISSION.replication.wait_s / MISSION.tick_s)
NOBODY: frozenset[str] = frozenset()
FAULTY_TICKS, CLEAN_TICKS = 60, 50
NO_REPLICA = ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0)


def pose(drone: int, tick: int) -> tuple[float, float, float, float, float]:
    angle = 0.05 * tick + drone
    return (2 * math.cos(angle), 2 * math.sin(angle), 1.6, angle, 1.3)


def state(drone: int, tick: int, repeats: int = 0) -> DroneState:
    return DroneState(
        drone=drone,
        tick=tick,
        pose=pose(drone, tick),
        velocity=(0.0,) * 5,
        battery=1.0,
        mode="flying",
        earlier=tuple((before, pose(drone, before)) for before in range(max(0, tick - repeats), tick)),
        importance=1.0,
        replica=NO_REPLICA,
        control=None,
    )


def beat(tick: int, live: tuple[int, ...] = DRONES) -> Tick:
    return Tick(
        tick=tick, time_s=tick * 0.05, lockstep=False, live=live, vehicles=(), jump_epoch=0, next_jump=0, keyframes=0
    )


def jump(epoch: int, sequence: int, tick: int) -> Jump:
    increments = np.random.default_rng(sequence).uniform(0, 0.5, POSITIONS).astype(np.float32)
    return Jump(epoch=epoch, sequence=sequence, tick=tick, increments=increments)


class Team:
    """A ground station's replication and those of three drones, and a network that a test makes bad."""

    def __init__(
        self, seed: int = 0, *, loss: float = 0.0, delay_ticks: int = 0, repeats: int = 0, mission: Mission = MISSION
    ) -> None:
        self.random = random.Random(seed)
        self.loss, self.delay_ticks, self.repeats = loss, delay_ticks, repeats
        self.tick = 0
        self.epoch = 11
        self.journal: list[Jump] = []
        self.compacted = 0
        self.ground = Replication(mission, authority=True, epoch=self.epoch)
        self.drones = {drone: Replication(mission, drone) for drone in DRONES}
        self.unreachable: set[int] = set()
        self.on_the_way: list[tuple[int, Replication, object]] = []

    def send(self, receiver: Replication, message: object) -> None:
        own = next((drone for drone, known in self.drones.items() if known is receiver), 0)
        if own in self.unreachable or self.random.random() < self.loss:
            return
        self.on_the_way.append((self.tick + self.random.randint(0, self.delay_ticks), receiver, message))

    def deliver(self) -> None:
        arriving = [entry for entry in self.on_the_way if entry[0] <= self.tick]
        self.on_the_way = [entry for entry in self.on_the_way if entry[0] > self.tick]
        self.random.shuffle(arriving)
        for _, receiver, message in arriving:
            hear = {
                "state": receiver.hear_state, "jump": receiver.hear_jump, "jump_head": receiver.hear_head,
                "phi_digest": receiver.hear_digest,
            }[message.name]  # type: ignore[attr-defined]  # fmt: skip
            hear(message)  # type: ignore[operator]

    def everyone(self) -> Iterator[Replication]:
        yield self.ground
        yield from self.drones.values()

    def publish_jump(self) -> None:
        made = jump(self.epoch, len(self.journal), self.tick + 8)
        self.journal.append(made)
        self.ground.hear_jump(made)
        for replication in self.drones.values():
            self.send(replication, made)

    def step(self) -> None:
        for replication in self.everyone():
            replication.hear_tick(beat(self.tick))
        for drone, own in self.drones.items():
            own.hear_state(state(drone, self.tick))
            for other in self.everyone():
                if other is not own and drone not in self.unreachable:
                    self.send(other, state(drone, self.tick, self.repeats))
        if self.tick % 9 == 4:
            self.publish_jump()
        self.deliver()
        for replication in self.everyone():
            replication.integrate(self.tick, NOBODY, WAIT_TICKS)
        digests = self.ground.take_digests()
        head = JumpHead(epoch=self.epoch, next_sequence=len(self.journal), done=self.tick + 7, phase="flying")
        for replication in self.drones.values():
            self.send(replication, head)
            for digest in digests:
                self.send(replication, digest)
        for drone, replication in self.drones.items():
            if drone not in self.unreachable and self.random.random() >= self.loss:
                self.answer(replication)
        self.tick += 1

    def answer(self, replication: Replication, source: Replication | None = None) -> None:
        """One query of ``replication``, answered by ``source`` as the ground station and the agents do."""
        request = replication.wants()
        if isinstance(request, JournalRequest):
            first = max(request.first, self.compacted)
            encoded = tuple(encode(each) for each in self.journal[first : min(request.last, first + 3)])
            page = JournalPage(
                epoch=self.epoch, first_sequence=self.compacted, next_sequence=len(self.journal), jumps=encoded
            )
            replication.hear_journal(page, request)
        elif isinstance(request, BlocksRequest):
            served = source or self.ground
            if served.known and served.replica.tick >= request.tick:
                replication.hear_page(served.page(list(request.blocks)))

    def fly(self, ticks: int) -> None:
        for _ in range(ticks):
            self.step()

    def heal(self) -> None:
        self.loss, self.delay_ticks = 0.0, 0
        self.unreachable.clear()
        self.fly(CLEAN_TICKS)

    def digests(self) -> set[str]:
        assert len({replication.replica.tick for replication in self.everyone()}) == 1
        return {replication.replica.field.sha256 for replication in self.everyone()}

    def applied(self) -> set[int]:
        return {replication.replica.jumps.taken for replication in self.everyone()}


def test_without_faults_nothing_is_ever_asked_for() -> None:
    team = Team()
    for _ in range(FAULTY_TICKS):
        team.step()
        assert all(replication.wants() is None for replication in team.everyone())
    assert len(team.digests()) == 1
    assert [replication.repaired for replication in team.everyone()] == [0] * 4


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**20),
    loss=st.sampled_from([0.0, 0.1, 0.3, 0.6]),
    delay_ticks=st.sampled_from([0, 3, 8, 20]),
    repeats=st.sampled_from([0, 3]),
)
def test_after_loss_delay_and_reordering_all_are_equal_to_the_last_bit(
    seed: int, loss: float, delay_ticks: int, repeats: int
) -> None:
    team = Team(seed, loss=loss, delay_ticks=delay_ticks, repeats=repeats)
    team.fly(FAULTY_TICKS)
    team.heal()

    assert len(team.digests()) == 1
    assert team.applied() == {team.ground.replica.jumps.taken}


@settings(max_examples=10, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**20))
def test_repeated_states_make_up_for_single_losses(seed: int) -> None:
    team = Team(seed, loss=0.1, repeats=3)
    team.fly(FAULTY_TICKS)

    assert sum(replication.lost for replication in team.everyone()) <= 2, "of 540, four in a row have to be lost"


@pytest.mark.parametrize("away_ticks", [5, 30, 150])
def test_a_drone_that_was_cut_off_takes_over_what_it_missed(away_ticks: int) -> None:
    team = Team()
    team.fly(20)
    team.unreachable = {3}
    team.fly(away_ticks)
    team.heal()

    assert len(team.digests()) == 1


def test_with_the_default_tolerance_all_are_as_near_as_it_says() -> None:
    tolerance = Settings().tolerance
    coarse = MISSION.model_copy(update={"replication": Settings(tolerance=tolerance)})
    for seed in range(5):
        team = Team(seed, loss=0.4, delay_ticks=20, mission=coarse)
        team.fly(FAULTY_TICKS)
        team.heal()
        for replication in team.drones.values():
            apart = replication.replica.field.phi.astype(float) - team.ground.replica.field.phi
            for block in range(team.ground.replica.layout.count):
                rows = team.ground.replica.layout.rows(block)
                assert np.sqrt((apart[rows] ** 2).mean()) <= 2 * tolerance, "a sketch of three is an estimate"


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_one_that_starts_late_has_all_of_phi_and_every_jump_once(loss: float) -> None:
    team = Team(loss=loss, delay_ticks=2)
    team.fly(40)
    late = Replication(MISSION, 3)
    team.drones[3] = late
    team.step()
    assert not late.known
    with pytest.raises(MessageError, match="not complete"):
        late.page([0])
    team.heal()

    assert late.known
    assert len(team.digests()) == 1
    assert team.applied() == {team.ground.replica.jumps.taken}


def test_one_whose_jumps_were_compacted_away_takes_phi_anew() -> None:
    team = Team()
    team.fly(10)
    team.unreachable = {7}
    team.fly(60)
    team.compacted = len(team.journal) - 1
    team.heal()

    assert len(team.digests()) == 1


def restart_ground(team: Team, epoch: int) -> None:
    """As after kill -9: from the journal, phi from a drone."""
    team.ground = Replication(MISSION, authority=True, epoch=epoch)
    if epoch == team.epoch:
        for each in team.journal:
            team.ground.hear_jump(each)
    else:
        team.epoch, team.journal = epoch, []
    team.ground.hear_tick(beat(team.tick))
    while not team.ground.known:
        team.step()
        team.answer(team.ground, team.drones[2])


def test_a_restarted_ground_station_goes_on_where_the_drones_are() -> None:
    team = Team()
    team.fly(43)
    before = team.drones[3].importance
    restart_ground(team, team.epoch)

    assert abs(team.ground.importance - before) < 0.05
    team.heal()
    assert len(team.digests()) == 1
    assert [team.drones[drone].repaired for drone in DRONES] == [0, 0, 0], "nobody had to be corrected"
    assert team.applied() == {team.ground.replica.jumps.taken}
    assert team.ground.replica.jumps.next_sequence == len(team.journal)


def test_a_new_epoch_is_taken_over_by_all_and_loses_nothing_of_phi() -> None:
    team = Team()
    team.fly(49)
    before = team.drones[2].importance
    restart_ground(team, 12)

    assert abs(team.ground.importance - before) < 0.05, "what the old epoch's jumps did is kept"
    team.heal()
    assert {replication.replica.jumps.epoch for replication in team.everyone()} == {12}
    assert len(team.digests()) == 1
    assert team.applied() == {team.ground.replica.jumps.taken}


def test_jumps_that_fall_due_before_a_restarted_ground_station_has_phi_count_once() -> None:
    team = Team()
    team.fly(43)
    team.ground = Replication(MISSION, authority=True, epoch=team.epoch)
    for each in team.journal:
        team.ground.hear_jump(each)
    team.fly(30)
    assert not team.ground.whole
    while not team.ground.whole:
        team.step()
        team.answer(team.ground, team.drones[7])
    team.heal()

    assert len(team.digests()) == 1
    assert team.applied() == {team.ground.replica.jumps.taken}
    assert {each.replica.jumps.next_sequence for each in team.everyone()} == {len(team.journal)}


def test_one_that_takes_phi_anew_does_not_pass_on_what_it_no_longer_has() -> None:
    team = Team()
    team.fly(20)
    team.unreachable = {3}
    slept = team.drones[3]
    for _ in range(150):
        team.step()
    slept._now = team.tick - 151  # as one that was stopped: it heard no tick either
    slept.replica.tick = team.tick - 151
    slept.integrate(team.tick, NOBODY, WAIT_TICKS)
    assert slept.known, "it may still fly by it"
    with pytest.raises(MessageError, match="not complete"):
        slept.page([0])
    team.heal()
    assert slept.whole
    assert len(team.digests()) == 1


def test_without_a_ground_station_one_that_slept_keeps_what_it_has() -> None:
    team = Team()
    team.fly(20)
    slept = team.drones[3]
    slept.hear_tick(beat(300))
    slept.integrate(300, {"ground"}, WAIT_TICKS)

    assert slept.whole
    assert slept.replica.tick >= 300 - WAIT_TICKS
    assert slept.lost > 200, "whoever has to choose a phi is told"


def test_a_page_that_lacks_a_jump_which_the_replica_no_longer_remembers_is_not_placed() -> None:
    team = Team()
    team.fly(40)
    slept = team.drones[3]
    before = team.ground.page([0])
    page = before.model_copy(update={"tick": slept.replica.tick, "next_sequence": slept.replica.jumps.taken - 1})
    slept.replica._steps.clear()

    slept.hear_page(page)

    assert slept.replica.field.sha256 == team.drones[2].replica.field.sha256


def test_an_old_head_that_comes_late_changes_no_epoch() -> None:
    team = Team()
    team.fly(20)
    old = JumpHead(epoch=5, next_sequence=90, done=500, phase="flying")
    team.drones[2].hear_head(old)
    team.heal()

    assert team.drones[2].replica.jumps.epoch == team.epoch
    assert len(team.digests()) == 1


def test_phi_is_never_older_than_the_mission_allows() -> None:
    team = Team()
    team.unreachable = {2, 3, 7}
    for _ in range(40):
        team.step()
        for replication in team.everyone():
            assert team.tick - replication.replica.tick <= WAIT_TICKS


def test_a_tick_waits_for_all_who_are_live_at_it_but_those_who_are_gone() -> None:
    """Not only for those whose token has come: it may come later than the first tick, and then runs would differ."""
    alone = Replication(MISSION, 2)
    alone.hear_tick(beat(0))
    alone.hear_state(state(2, 0))

    assert not alone.is_ready(0, NOBODY)
    assert not alone.is_ready(0, {"ground", "drone/7"}), "a state may still come"
    assert not alone.is_ready(0, {"drone/3", "drone/7"}), "a jump may still come"
    assert alone.is_ready(0, {"ground", "drone/3", "drone/7"})


def test_states_of_strangers_and_of_clocks_that_are_ahead_are_refused() -> None:
    own = Replication(MISSION, 2)
    own.hear_tick(beat(0))

    assert own.hear_state(state(3, AHEAD_TICKS))
    assert not own.hear_state(state(3, AHEAD_TICKS + 1))
    assert not own.hear_state(state(99, 0))
    assert own.refused == 2


@pytest.mark.parametrize(
    "change",
    [
        {"blocks": np.array([0, 0], np.int32)},
        {"blocks": np.array([-1, 0], np.int32)},
        {"blocks": np.array([0, 10_000], np.int32)},
        {"blocks": np.array([[0, 1]], np.int32)},
        {"blocks": np.array([0.0, 1.0], np.float32)},
        {"phi": np.zeros((3, 3), np.float32)},
        {"phi": np.zeros(5, np.float64)},
    ],
)
def test_pages_that_do_not_fit_the_field_are_refused_and_change_nothing(change: dict[str, np.ndarray]) -> None:
    team = Team()
    team.fly(3)
    drone = team.drones[2]
    before = drone.replica.field.sha256
    page = PhiPage.model_validate(team.ground.page([0, 1]).__dict__ | change)

    drone.hear_page(page)

    assert (drone.refused, drone.replica.field.sha256) == (1, before)
