"""States arrive in any order and are integrated in one."""

from __future__ import annotations

from protocol.messages import DroneState, ReplicaState
from protocol.state_log import HISTORY_TICKS, StateLog


def state(drone: int, tick: int) -> DroneState:
    return DroneState(
        drone=drone,
        tick=tick,
        pose=(float(drone), float(tick), 2.0, 0.0, 1.3),
        velocity=(0.0, 0.0, 0.0, 0.0, 0.0),
        battery=1.0,
        mode="flying",
        importance=1.0,
        replica=ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0),
        control=None,
    )


def log_of(*entries: tuple[int, int]) -> StateLog:
    log = StateLog()
    for drone, tick in entries:
        log.hear(state(drone, tick))
    return log


def test_poses_are_ordered_by_drone_however_they_came() -> None:
    log = log_of((9, 5), (1, 5), (4, 5), (4, 6))

    ids, poses = log.poses_at(5, [9, 4, 1])

    assert ids == [1, 4, 9]
    assert poses.tolist() == [[drone, 5.0, 2.0, 0.0, 1.3] for drone in (1, 4, 9)]


def test_only_those_asked_for_and_heard_of_are_told() -> None:
    log = log_of((1, 5), (2, 5), (3, 4))

    ids, poses = log.poses_at(5, {2, 3})

    assert ids == [2]
    assert poses.shape == (1, 5)


def test_a_tick_that_nobody_spoke_of_has_no_poses() -> None:
    ids, poses = StateLog().poses_at(7, [1, 2])

    assert ids == []
    assert poses.shape == (0, 5)


def test_a_tick_is_complete_once_all_who_are_waited_for_have_spoken() -> None:
    log = log_of((1, 5), (3, 5), (2, 4))

    assert log.has_all(5, [1, 3])
    assert log.has_all(5, [])
    assert not log.has_all(5, [1, 2])
    assert not log.has_all(6, [1])


def test_a_state_that_comes_again_counts_once() -> None:
    assert log_of((1, 5), (1, 5)).poses_at(5, [1])[1].shape == (1, 5)


def test_old_ticks_are_forgotten_and_recent_ones_kept() -> None:
    log = log_of((1, 10), (1, 11), (1, 50))

    log.forget_before(11 + HISTORY_TICKS)

    assert not log.has_all(10, [1])
    assert log.has_all(11, [1])
    assert log.has_all(50, [1])
