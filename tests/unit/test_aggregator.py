"""Whatever a bad link or a broken drone does, gathered states tell what was said, and for how long ago."""

from __future__ import annotations

import random
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.team import Team
from protocol import topics
from protocol.aggregator import POSES_MAX, REPEATED, TICK_MAX, Gatherer, is_gathered
from protocol.messages import DroneState, ReplicaState, Tick, Vector5
from protocol.mission import Drone, Mission, Target
from protocol.replication import Replication
from protocol.team_states import Sighting, unpack
from protocol.transport_settings import Transport
from protocol.wire import decode, encode

DRONES = (2, 3, 7)
NO_REPLICA = ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0)
MISSION = Mission(
    target=Target(cell_m=0.5, cell_rad=0.8),
    drones=tuple(Drone(id=drone, start=(1.5 * k - 2, 0.0, 2.0, 0.0, 1.3)) for k, drone in enumerate(DRONES)),
)
WAIT_TICKS = round(MISSION.replication.wait_s / MISSION.tick_s)
EARLIER = 3


def pose(drone: int, tick: int) -> Vector5:
    angle = 0.05 * tick + drone
    return (2 * np.cos(angle), 2 * np.sin(angle), 1.6, angle, 1.3)


def state(drone: int, tick: int, earlier: int = 0) -> DroneState:
    return DroneState(
        drone=drone,
        tick=tick,
        pose=pose(drone, tick),
        velocity=(0.1, 0.2, 0.3, 0.0, 0.0),
        battery=1.0,
        mode="flying",
        earlier=tuple((before, pose(drone, before)) for before in range(max(0, tick - earlier), tick)),
        importance=1.0,
        replica=NO_REPLICA,
        control=None,
    )


def beat(tick: int, live: tuple[int, ...] = DRONES) -> Tick:
    return Tick(
        tick=tick, time_s=tick * 0.05, lockstep=False, live=live, vehicles=(), jump_epoch=0, next_jump=0, keyframes=0
    )


def heard(gatherer: Gatherer) -> list[Sighting]:
    message = gatherer.take()
    return [] if message is None else unpack(message)


def ticks_of(sighting: Sighting) -> set[int]:
    return {sighting.tick, *(tick for tick, _ in sighting.earlier)}


# --- what is told ----------------------------------------------------------------------------------------------------


def test_a_round_tells_the_newest_state_of_each_drone_by_id() -> None:
    gatherer = Gatherer(DRONES)
    for drone in (7, 2, 3):
        gatherer.hear(state(drone, 5))

    assert [(sighting.drone, sighting.tick, sighting.pose) for sighting in heard(gatherer)] == [
        (drone, 5, pose(drone, 5)) for drone in DRONES
    ]


def test_nothing_is_told_before_anybody_has_spoken() -> None:
    assert Gatherer(DRONES).take() is None


def test_each_pose_is_told_in_so_many_messages_and_then_no_more() -> None:
    gatherer, told = Gatherer(DRONES), defaultdict(list)
    for tick in range(20):
        gatherer.hear(state(2, tick, EARLIER))
        for sighting in heard(gatherer):
            for mentioned in ticks_of(sighting):
                told[mentioned].append(tick)

    assert all(told[tick] == list(range(tick, tick + REPEATED + 1)) for tick in range(20 - REPEATED))


def test_a_silent_drone_keeps_its_tick_and_is_then_told_of_no_more() -> None:
    gatherer = Gatherer(DRONES)
    gatherer.hear(state(2, 10))
    for tick in range(10, 20):
        gatherer.hear(state(3, tick))
        seen = {sighting.drone: sighting.tick for sighting in heard(gatherer)}
        assert seen == ({2: 10, 3: tick} if tick <= 10 + REPEATED else {3: tick})


def test_an_older_state_replaces_no_newer_one_but_its_pose_is_told() -> None:
    gatherer = Gatherer(DRONES)
    gatherer.hear(state(2, 11))
    gatherer.hear(state(2, 9))

    (sighting,) = heard(gatherer)
    assert (sighting.tick, sighting.pose) == (11, pose(2, 11))
    assert sighting.earlier == [(9, pose(2, 9))]


def test_what_was_lost_on_the_way_up_is_told_from_the_repeats() -> None:
    gatherer = Gatherer(DRONES)
    gatherer.hear(state(2, 10, EARLIER))
    gatherer.take()
    gatherer.hear(state(2, 13, EARLIER))

    (sighting,) = heard(gatherer)
    assert ticks_of(sighting) == {7, 8, 9, 10, 11, 12, 13}


def test_a_mission_that_begins_anew_is_heard_though_its_ticks_are_small() -> None:
    gatherer = Gatherer(DRONES)
    gatherer.hear(state(2, 30_000))
    for _ in range(REPEATED + 1):
        gatherer.take()
    gatherer.hear(state(2, 0))

    (sighting,) = heard(gatherer)
    assert (sighting.tick, sighting.earlier) == (0, [])


def test_a_clock_that_was_ahead_and_is_right_again_is_believed_soon() -> None:
    gatherer = Gatherer(DRONES)
    gatherer.hear(state(2, 9_000))
    newest = []
    for tick in range(10, 20):
        gatherer.hear(state(2, tick))
        newest.append(heard(gatherer)[0].tick)

    assert newest == [9_000] * (REPEATED + 1) + list(range(10 + REPEATED + 1, 20))


def test_strangers_and_ticks_that_cannot_be_are_refused() -> None:
    gatherer = Gatherer(DRONES)
    gatherer.hear(state(9, 5))
    gatherer.hear(state(2, 5).model_copy(update={"tick": TICK_MAX + 1}))
    gatherer.hear(state(2, 5).model_copy(update={"earlier": ((TICK_MAX + 1, pose(2, 0)),)}))

    assert gatherer.take() is None
    assert gatherer.refused == 3


def test_drones_that_flood_the_router_fill_neither_its_memory_nor_the_message() -> None:
    gatherer = Gatherer(range(1, 256))
    for drone in range(1, 256):
        for tick in range(100):
            gatherer.hear(state(drone, tick))

    assert all(len(spoken.poses) <= POSES_MAX for spoken in gatherer._spoken.values())
    message = gatherer.take()
    assert message is not None
    assert len(encode(message)) < topics.TEAM.max_bytes


def test_states_are_complete_once_all_live_drones_have_spoken_since_the_beat() -> None:
    gatherer = Gatherer(DRONES)
    gatherer.hear_tick(beat(5, live=(2, 7, 99)))
    assert not gatherer.is_complete
    gatherer.hear(state(2, 5))
    gatherer.hear(state(7, 4))
    assert not gatherer.is_complete
    gatherer.hear(state(7, 5))
    assert gatherer.is_complete
    gatherer.hear_tick(beat(6, live=(2, 7)))
    assert not gatherer.is_complete


@pytest.mark.parametrize(
    ("above", "lockstep", "gathered"), [(3, False, False), (2, False, True), (0, False, True), (0, True, False)]
)
def test_only_large_teams_in_real_time_are_gathered(above: int, lockstep: bool, gathered: bool) -> None:
    mission = MISSION.model_copy(update={"transport": Transport(aggregate_above=above)})

    assert is_gathered(mission, lockstep=lockstep) == gathered


# --- what is lost ----------------------------------------------------------------------------------------------------


def arrived(lost: list[bool], up: list[set[int]]) -> dict[int, set[int]]:
    """Ticks of each drone that came through, of as many rounds as ``lost``; ``up``: by tick, whose states do not reach
    the router."""
    gatherer, known = Gatherer(DRONES), defaultdict(set)
    for tick, message_lost in enumerate(lost):
        for drone in DRONES:
            if drone not in up[tick]:
                gatherer.hear(state(drone, tick, EARLIER))
        for sighting in heard(gatherer):
            if not message_lost:
                known[sighting.drone] |= ticks_of(sighting)
    return known


@given(
    lost=st.lists(st.tuples(st.integers(0, REPEATED), st.integers(1, 5)), min_size=1, max_size=8),
    up=st.lists(st.sampled_from([set(), set(), set(), {2}, {2, 7}]), min_size=1, max_size=72),
)
def test_no_state_is_lost_while_fewer_messages_in_a_row_are_than_tell_it(
    lost: list[tuple[int, int]], up: list[set[int]]
) -> None:
    """Bursts of up to `REPEATED` gathered messages, with states lost on the way up besides."""
    messages = [gone for bad, good in lost for gone in [True] * bad + [False] * good] + [False] * (REPEATED + 1)
    ticks = len(messages)
    silent = [*(up * ticks)[: ticks - 1], set()]
    for tick in range(EARLIER, ticks):  # no drone is unheard for longer than its own repeats last
        if all(silent[before] for before in range(tick - EARLIER, tick)):
            silent[tick] = set()

    known = arrived(messages, silent)

    assert all(known[drone] >= set(range(ticks)) for drone in DRONES)


@pytest.mark.parametrize("seed", range(5))
def test_with_one_gathered_message_in_ten_lost_one_state_in_a_thousand_is_at_most(seed: int) -> None:
    dice, ticks = random.Random(seed), 4_000
    lost = [dice.random() < 0.1 for _ in range(ticks)] + [False] * (REPEATED + 1)

    known = arrived(lost, [set()] * len(lost))

    missing = sum(len(set(range(ticks)) - known[drone]) for drone in DRONES)
    assert lost.count(True) > ticks / 12
    assert missing <= ticks * len(DRONES) / 1000


# --- what it comes to ------------------------------------------------------------------------------------------------


def test_phi_of_gathered_states_is_that_of_direct_ones_to_the_last_bit() -> None:
    """With every third gathered message lost, and what came twice."""
    direct, gathered = Replication(MISSION, 2), Replication(MISSION, 2)
    gatherer = Gatherer(DRONES)
    for tick in range(200):
        for replication in (direct, gathered):
            replication.hear_tick(beat(tick))
            replication.hear_state(state(2, tick))
        for drone in DRONES:
            said = decode(DroneState, encode(state(drone, tick, EARLIER)))
            gatherer.hear(said)
            if drone != 2:
                direct.hear_state(said)
        for sighting in heard(gatherer):
            if sighting.drone != 2 and tick % 3:
                gathered.hear_state(sighting)
        for replication in (direct, gathered):
            replication.integrate(tick, {"ground"}, WAIT_TICKS)

    assert direct.lost == gathered.lost == 0
    assert direct.replica.tick == gathered.replica.tick == 200
    assert gathered.replica.field.sha256 == direct.replica.field.sha256
    assert gathered.importance == direct.importance < 0.9


def test_neighbours_are_the_same_obstacles_however_they_are_heard_of() -> None:
    starts = {drone.id: drone.start for drone in MISSION.drones}
    direct, gathered = (Team(2, starts, MISSION.flight, MISSION.tick_s) for _ in range(2))
    gatherer = Gatherer(DRONES)
    said = {
        3: state(3, 8).model_copy(update={"blind_s": 1.5}),
        7: state(7, 8).model_copy(update={"mode": "landed"}),
    }
    for message in said.values():
        direct.hear(message, now=8)
        gatherer.hear(message)
    for _ in range(REPEATED + 3):
        for sighting in heard(gatherer):
            gathered.hear(sighting, now=8)

    for tick in (8, 9, 40):
        assert [(n.drone, n.position.tolist(), n.age_s) for n in direct.neighbours(tick)] == [
            (n.drone, n.position.tolist(), n.age_s) for n in gathered.neighbours(tick)
        ]
    assert gathered.neighbours(40)[0].age_s == pytest.approx(1.6 + 1.5), "silence grows by tick"
