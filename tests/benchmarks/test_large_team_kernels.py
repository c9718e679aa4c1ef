"""What each drone of a large team computes in a tick: phi decays by all of them, and all are rows of its program."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import numpy as np

from agents.barriers import Neighbour
from agents.planners.coverage import CoverageController
from protocol.aggregator import Gatherer
from protocol.field import VirtualField
from protocol.formation import formation
from protocol.importance import ImportanceField, SamplingTerms
from protocol.messages import DroneState, TeamStates
from protocol.mission import Drone, Flight, Mission, Sensing, Target
from protocol.team_states import unpack
from protocol.traffic_samples import state
from protocol.wire import decode, encode

Record = Callable[..., None]
TEAMS = (8, 32, 128, 255)
AREA_M2 = 9.0
"""Of the target, for each drone: as four have in the default one."""
WIDE = Flight(lower_m=(-60.0, -60.0, 0.5), upper_m=(60.0, 60.0, 5.0))
TICK_MS = 50.0


def median_ms(action: Callable[[], object], repeats: int = 40) -> float:
    """Median CPU time of one call."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        action()
        times.append(time.process_time() - began)
    return 1e3 * statistics.median(times)


def test_integrating_a_team(record: Record) -> None:
    for count in TEAMS:
        dice = np.random.default_rng(count)
        half_m = math.sqrt(AREA_M2 * count) / 2
        target = Target(lower_m=(-half_m, -half_m, 0.0), upper_m=(half_m, half_m, 2.0))
        field = ImportanceField(VirtualField.of(target), Sensing())
        low, high = (-half_m, -half_m, 1.0, -3.0, 1.05), (half_m, half_m, 2.0, 3.0, 1.57)
        poses = dice.uniform(low, high, (count, 5))
        field.advance(poses, TICK_MS / 1e3, 0)
        took_ms = median_ms(lambda field=field, poses=poses: field.advance(poses, TICK_MS / 1e3, 0))
        record(f"team_{count}_phi_tick", took_ms, "ms CPU", "a tick", TICK_MS / took_ms)


def test_steering_among_a_team(record: Record) -> None:
    for count in TEAMS:
        drones = tuple(Drone(id=k, start=start) for k, start in enumerate(formation(WIDE, count), start=1))
        controller = CoverageController(Mission(flight=WIDE, drones=drones), count - 1)
        own = drones[count // 2]
        others = [Neighbour(drone.id, np.array(drone.start[:3]), 0.05) for drone in drones if drone is not own]
        dice, pose = np.random.default_rng(count), np.array(own.start)
        terms = [SamplingTerms(dice.normal(0, 300, 5), 50.0, 20.0) for _ in range(100)]
        took_ms = median_ms(lambda: controller.decide(pose, np.zeros(5), others, terms.pop(), 3000.0))  # noqa: B023
        record(f"team_{count}_decision", took_ms, "ms CPU", "a tick", TICK_MS / took_ms)


def test_hearing_a_team(record: Record) -> None:
    for count in TEAMS:
        gatherer = Gatherer(range(1, count + 1))
        for drone in range(1, count + 1):
            gatherer.hear(state(drone))
        message = gatherer.take()
        assert message is not None
        gathered, one = encode(message), encode(state(count))
        at_once_ms = median_ms(lambda gathered=gathered: unpack(decode(TeamStates, gathered)))
        each_ms = median_ms(lambda one=one: [decode(DroneState, one) for _ in range(100)]) * (count - 1) / 100
        record(f"team_{count}_decoding", at_once_ms, "ms CPU", "each state by itself", each_ms / at_once_ms)
