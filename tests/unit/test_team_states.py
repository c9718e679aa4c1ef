"""A team's states come out of one message as each of them went in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import MessageError
from protocol.messages import DroneState, Mode, ReplicaState, TeamStates, Vector5
from protocol.team_states import Sighting, TimedPose, pack, unpack
from protocol.wire import decode, encode

NO_REPLICA = ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0)
coordinates = st.floats(-1e6, 1e6)
poses = st.tuples(*[coordinates] * 5)
ticks = st.integers(0, 2**31 - 1)


def state(
    drone: int,
    tick: int,
    pose: Vector5,
    velocity: Vector5 = (0.0,) * 5,
    blind_s: float = 0.0,
    mode: Mode = "flying",
    position_sd_m: float = 0.0,
) -> DroneState:
    return DroneState(
        drone=drone,
        tick=tick,
        pose=pose,
        velocity=velocity,
        battery=1.0,
        mode=mode,
        blind_s=blind_s,
        importance=1.0,
        replica=NO_REPLICA,
        control=None,
        position_sd_m=position_sd_m,
    )


@st.composite
def told(draw: st.DrawFn) -> list[tuple[DroneState, list[TimedPose]]]:
    ids = draw(st.lists(st.integers(1, 255), max_size=6, unique=True))
    modes: st.SearchStrategy[Mode] = st.sampled_from(["flying", "landed"])
    return [
        (
            state(
                drone,
                draw(ticks),
                draw(poses),
                draw(poses),
                draw(st.floats(0, 60)),
                draw(modes),
                draw(st.floats(0, 10)),
            ),
            draw(st.lists(st.tuples(ticks, poses), max_size=4)),
        )
        for drone in sorted(ids)
    ]


@given(told=told())
def test_all_that_the_others_fly_by_comes_out_to_the_last_bit(told: list[tuple[DroneState, list[TimedPose]]]) -> None:
    sightings = unpack(decode(TeamStates, encode(pack(told))))

    assert sightings == [
        Sighting(
            state.drone,
            state.tick,
            state.pose,
            state.velocity,
            state.blind_s,
            state.mode == "landed",
            earlier,
            state.position_sd_m,
        )
        for state, earlier in told
    ]


def test_a_team_at_the_limit_of_ids_and_repeats_is_one_batch_of_the_transport() -> None:
    pose = (0.1, 0.2, 0.3, 0.4, 0.5)
    message = pack((state(drone, 2**31 - 1, pose), [(tick, pose) for tick in range(3)]) for drone in range(1, 256))

    assert len(encode(message)) < 65_000, "longer ones are cut"


SOUND = pack(
    [(state(3, 7, (1.0, 2.0, 3.0, 0.0, 1.3)), [(6, (1.0, 2.0, 2.9, 0.0, 1.3))]), (state(5, 7, (0.0,) * 5), [])]
)


@pytest.mark.parametrize(
    ("field", "array"),
    [
        ("drones", np.array([0, 5], np.uint8)),
        ("drones", np.array([3, 5], np.int32)),
        ("drones", np.array([3], np.uint8)),
        ("ticks", np.array([7, -1], np.int32)),
        ("ticks", np.array([[7, 7]], np.int32)),
        ("poses", np.zeros((2, 6))),
        ("poses", np.full((2, 5), 1e7)),
        ("poses", np.zeros((2, 5), np.float32)),
        ("velocities", np.full((2, 5), -1e7)),
        ("blind_s", np.array([0.0, -0.5])),
        ("blind_s", np.array([0.0, 61.0])),
        ("landed", np.zeros(3, np.uint8)),
        ("earlier_rows", np.array([2], np.uint8)),
        ("earlier_rows", np.array([0, 1], np.uint8)),
        ("earlier_ticks", np.array([-3], np.int32)),
        ("earlier_poses", np.full((1, 5), 2e6)),
    ],
)
def test_arrays_that_do_not_fit_or_hold_what_no_state_may_are_refused(field: str, array: np.ndarray) -> None:
    unpack(SOUND)
    with pytest.raises(MessageError, match="team_states"):
        unpack(SOUND.model_copy(update={field: array}))


def test_a_router_that_knows_no_deviations_leaves_them_at_none() -> None:
    told = pack([(state(3, 7, (1.0, 2.0, 3.0, 0.1, 1.3), position_sd_m=0.4), [])])
    older = told.model_copy(update={"position_sd_m": None})

    assert unpack(decode(TeamStates, encode(older)))[0].position_sd_m == 0.0


@pytest.mark.parametrize("wrong", [np.zeros(2), np.full(1, -0.1), np.zeros(1, np.float32)])
def test_deviations_that_cannot_be_are_refused(wrong: np.ndarray) -> None:
    told = pack([(state(3, 7, (1.0, 2.0, 3.0, 0.1, 1.3)), [])])

    with pytest.raises(MessageError):
        unpack(told.model_copy(update={"position_sd_m": wrong}))
