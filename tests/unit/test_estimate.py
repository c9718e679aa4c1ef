"""What simulated vehicles believe of themselves, and who is told what is true."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.pose_errors import KEPT_TICKS, PoseErrors
from protocol.localization_settings import EstimateNoise
from protocol.messages import DroneState, ReplicaState, Tick, VehicleSample
from sim_bridge.believed import KEPT_TICKS as BELIEVED_TICKS
from sim_bridge.believed import BelievedPoses
from sim_bridge.estimate import EstimateError

NOISE = EstimateNoise(drift_m=0.1, drift_rad=0.02, velocity_mps=0.05, drift_s=4.0, white_m=0.01, white_rad=0.003)
TRUTH = np.array([1.0, 2.0, 3.0, 3.1, 1.3])
TICK_S = 0.05


def error(seed: int = 1, drone: int = 1, noise: EstimateNoise = NOISE) -> EstimateError:
    return EstimateError(noise, seed, drone, TICK_S)


def test_the_start_is_known() -> None:
    assert error().pose(TRUTH).tolist() == TRUTH.tolist()
    assert error().deviations == (NOISE.white_m, NOISE.white_rad)


def test_errors_are_as_large_as_the_vehicle_says_at_all_times() -> None:
    off: dict[int, list[np.ndarray]] = {10: [], 100: []}
    told = {}
    for seed in range(300):
        one = error(seed)
        for tick in range(1, 101):
            one.step()
            if tick in off:
                off[tick].append(one.pose(TRUTH) - TRUTH)
                told[tick] = one.deviations
    for tick, errors in off.items():
        spread = np.array(errors)[:, :3].std()
        assert spread == pytest.approx(told[tick][0], rel=0.1)
    assert told[10][0] < 0.6 * told[100][0]


def test_slow_errors_are_slow() -> None:
    one = error(noise=NOISE.model_copy(update={"white_m": 0.0}))
    steps, last = [], TRUTH
    for _ in range(400):
        one.step()
        now = one.pose(TRUTH)
        steps.append(abs(now[0] - last[0]))
        last = now
    assert max(steps) < 0.1


def test_errors_depend_on_seed_and_drone_and_can_be_repeated() -> None:
    def flown(seed: int, drone: int) -> list[float]:
        one = error(seed, drone)
        for _ in range(5):
            one.step()
        return [*one.pose(TRUTH).tolist(), *one.velocity(np.zeros(5)).tolist()]

    assert flown(1, 1) == flown(1, 1)
    assert flown(1, 1) != flown(1, 2)
    assert flown(1, 1) != flown(2, 1)


def test_yaw_stays_an_angle() -> None:
    one = error(noise=NOISE.model_copy(update={"drift_rad": 1.0}))
    for _ in range(200):
        one.step()
        assert -np.pi <= one.pose(TRUTH)[3] <= np.pi


def state(drone: int, tick: int, x: float) -> DroneState:
    return DroneState(
        drone=drone, tick=tick, pose=(x, 0.0, 2.0, 0.0, 1.3), velocity=(0.0,) * 5, battery=1.0, mode="flying",
        importance=1.0, control=None, position_sd_m=0.05,
        replica=ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0),
    )  # fmt: skip


def test_cameras_see_from_where_drones_are_and_say_where_they_believed_to_be() -> None:
    believed = BelievedPoses()
    believed.note_truth(3, {1: TRUTH, 2: TRUTH + 1}, {1: np.zeros(5), 2: np.ones(5)})
    believed.hear(state(2, 3, 5.0))
    assert believed.has(3, [2])
    assert not believed.has(3, [1, 2])
    believed.hear(state(1, 3, 4.0))
    first, second = believed.take()
    assert (first.drone, first.tick, first.deviations) == (1, 3, (0.05, 0.0))
    assert first.truth.tolist() == TRUTH.tolist()
    assert (first.believed[0], second.believed[0]) == (4.0, 5.0)
    assert believed.take() == [], "each state once"


def test_a_state_whose_truth_is_forgotten_takes_no_picture() -> None:
    believed = BelievedPoses()
    for tick in range(BELIEVED_TICKS + 1):
        believed.note_truth(tick, {1: TRUTH}, {1: np.zeros(5)})
    believed.hear(state(1, 0, 4.0))
    assert believed.take() == []


def tick(number: int, truth: bool = True) -> Tick:
    samples = tuple(
        VehicleSample(
            drone=drone, pose=(0.0,) * 5, velocity=(0.0,) * 5, battery=1.0, setpoint_tick=0,
            truth=(float(drone), 0.0, 0.0, 0.0, 1.3) if truth else None,
        )
        for drone in (1, 2)
    )  # fmt: skip
    return Tick(
        tick=number, time_s=0.05 * number, lockstep=True, live=(1, 2), vehicles=samples, jump_epoch=0, next_jump=0,
        keyframes=0,
    )  # fmt: skip


def test_errors_are_those_of_poses_at_their_own_tick() -> None:
    errors = PoseErrors()
    errors.hear(tick(4))
    errors.note(4, {1: (1.3, 0.0, 0.0, 0.1, 1.3), 2: (2.0, 0.4, 0.0, 0.0, 1.3)}, {1: 1.0, 2: 0.3})
    figures = errors.figures
    assert figures is not None
    assert figures.rms_m == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert (figures.max_m, figures.final_m) == (pytest.approx(0.4), pytest.approx(0.4))
    assert figures.yaw_rms_rad == pytest.approx(0.1 / np.sqrt(2))
    assert figures.beyond == 0.5
    errors.note(5, {1: (9.0, 0.0, 0.0, 0.1, 1.3)}, {})
    assert errors.figures == figures, "of tick 5 no truth was told"


def test_without_a_truth_there_are_no_errors_and_old_truths_are_forgotten() -> None:
    errors = PoseErrors()
    errors.hear(tick(0, truth=False))
    errors.note(0, {1: (1.0, 0.0, 0.0, 0.0, 1.3)}, {})
    assert errors.figures is None
    for number in range(KEPT_TICKS + 1):
        errors.hear(tick(number))
    assert errors.truth(0) == {}
    assert set(errors.truth(1)) == {1, 2}
