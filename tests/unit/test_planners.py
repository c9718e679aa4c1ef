"""What each baseline does that the others do not."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from agents.barriers import Neighbour
from agents.planners.angle_aware import AngleAware
from agents.planners.angle_aware_down import AngleAwareDown
from agents.planners.lawnmower import WAIT_S, Lawnmower
from agents.planners.persistent import PersistentCoverage
from agents.planners.posture import TURNED_RAD
from agents.planners.safety_filter import SafetyFilter
from agents.planners.sweep import footprint_of
from agents.quadratic_program import NOTHING_HELD, Held
from faults.team_flight import TeamFlight
from protocol.geometry import Floats
from protocol.importance import SamplingTerms
from protocol.mission import Controller, Drone, Flight, Mission, Target
from protocol.planner_settings import PlannerName, Planners

STILL = np.zeros(5)
TERMS = SamplingTerms(np.array([300.0, -200.0, 500.0, 90.0, -60.0]), 20.0, 5.0)
CELLS = 200_000.0
"""So many that the sampling row wants all the speed there is."""
DOWN = math.pi / 2
READY = np.array([0.2, -0.3, 2.0, 0.7, DOWN - 0.01])
"""Camera down, at the height that baselines keep."""


def mission(planner: PlannerName, start: tuple[float, ...] = (0.0, 1.0, 2.0, 0.0, 1.3), **settings: object) -> Mission:
    return Mission.model_validate(
        {"controller": {"planner": planner}, "drones": [{"id": 1, "start": start}], **settings}
    )


@dataclass
class Asked:
    """Notes what a planner wants before the strict rows have their say."""

    xi1: list[Floats] = field(default_factory=list)
    xi2: list[float] = field(default_factory=list)
    held: list[Held] = field(default_factory=list)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    notes, solve = Asked(), SafetyFilter.solve

    def note(self: SafetyFilter, pose, velocity, neighbours, xi1, xi2, *, sampling=0.0, held=NOTHING_HELD):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
        notes.xi1.append(xi1)
        notes.xi2.append(xi2)
        notes.held.append(held)
        return solve(self, pose, velocity, neighbours, xi1, xi2, sampling=sampling, held=held)

    monkeypatch.setattr(SafetyFilter, "solve", note)
    return notes


# --- angle-aware -------------------------------------------------------------------------------------------------


def test_angle_aware_turns_its_camera_by_importance_and_keeps_its_height(asked: Asked) -> None:
    low = READY - np.array([0, 0, 0.4, 0, 0.2])

    decision = AngleAware(mission("angle_aware"), neighbours=0).decide(low, STILL, [], TERMS, CELLS)

    assert asked.xi1[0] == pytest.approx([900.0, -600.0, 0.0, 270.0, -180.0])
    assert decision.velocity[2] == pytest.approx(0.5, abs=1e-3), "up to its height, though importance pulls up as well"
    assert decision.velocity == pytest.approx([0.5, -0.5, 0.5, 0.5, decision.velocity[4]], abs=1e-3)
    assert decision.velocity[4] < -0.1
    assert decision.sampling == pytest.approx(60.0)


@pytest.mark.parametrize("planner", ["angle_aware_down", "persistent"])
def test_a_camera_that_is_to_look_down_is_turned_there_first_at_the_allowed_rate(planner: PlannerName) -> None:
    flight = TeamFlight(mission(planner, (0.5, 0.5, 2.0, 0.4, math.pi / 3)))
    (body,) = flight.bodies
    fastest = 0.0
    while body.pose[4] < DOWN - TURNED_RAD:
        assert flight.tick < 200
        assert body.pose[:4] == pytest.approx([0.5, 0.5, 2.0, 0.4], abs=1e-3), "in place"
        flight.step()
        fastest = max(fastest, body.velocity[4])
    assert fastest == pytest.approx(0.5, abs=0.02)
    for _ in range(200):
        flight.step()
        assert body.pose[3] == pytest.approx(0.4, abs=1e-3), "the yaw is all the same"
    assert flight.path_m > 0.5
    assert body.pose[4] == pytest.approx(DOWN, abs=1e-3)


def test_angle_aware_with_its_camera_down_moves_in_the_plane_alone(asked: Asked) -> None:
    decision = AngleAwareDown(mission("angle_aware_down"), neighbours=0).decide(READY, STILL, [], TERMS, CELLS)

    assert asked.xi1[0] == pytest.approx([900.0, -600.0, 0.0, 0.0, 0.0])
    assert decision.velocity == pytest.approx([0.5, -0.5, 0.0, 0.0, 0.01], abs=0.01)


# --- persistent --------------------------------------------------------------------------------------------------


def persistent(**planners: float) -> PersistentCoverage:
    return PersistentCoverage(mission("persistent", planners=planners), drone=1, neighbours=1)


def test_importance_falls_below_a_drone_and_grows_back_when_it_has_gone() -> None:
    planner = persistent(regrowth_per_s=0.05)
    here, away = READY.copy(), READY + np.array([2.5, 0.0, 0.0, 0.0, 0.0])
    here[4] = away[4] = DOWN
    xs, ys = planner._field.field.xs, planner._field.field.ys
    cell = int(np.abs(xs - here[0]).argmin()), int(np.abs(ys - here[1]).argmin())
    for _ in range(200):
        planner.note_team([1], here[None])
    seen = planner.importance[cell]
    assert seen < 0.05
    assert planner.importance.max() == pytest.approx(1.0)
    for _ in range(400):
        planner.note_team([1], away[None])

    assert planner.importance[cell] == pytest.approx(1 - (1 - seen) * math.exp(-0.05 * 20), abs=1e-3)


def test_without_growth_importance_only_falls() -> None:
    planner = persistent(regrowth_per_s=0.0)
    before = planner.importance
    for x in np.linspace(-2, 2, 200):
        planner.note_team([1], np.array([[x, 0.0, 2.0, 0.0, DOWN]]))
        assert (planner.importance <= before).all()
        before = planner.importance


def test_the_certificate_s_row_is_its_barrier_condition_with_the_growth() -> None:
    """b = I - |V| gamma on the planner's own field; the row says db/dt + a1 b >= w, here by finite differences."""
    planner = persistent(regrowth_per_s=0.3)
    for x in np.linspace(-1, 1, 100):
        planner.note_team([1], np.array([[x, 0.2, 2.0, 0.0, DOWN]]))
    pose, velocity = np.array([0.4, 0.5, 2.0, 0.0, DOWN]), np.array([0.3, -0.2, 0.0, 0.0, 0.0])
    own, cells = planner._field, planner._field.field
    settings = planner._mission
    decay = settings.sensing.decay_per_s

    def share(time_s: float) -> float:
        """I after a while of flight along ``velocity``, the field changing as if held in the pose at its start."""
        at = pose + time_s * velocity
        offsets = cells.positions() - pose[:3]
        phi0 = own.phi[:, 0].astype(float)
        rate = -decay * h1(offsets) * phi0 + 0.3 * (1 - phi0)
        return float(decay * (h1(cells.positions() - at[:3]) * (phi0 + time_s * rate)).sum())

    def h1(offsets: Floats) -> Floats:
        distance = np.linalg.norm(offsets, axis=1)
        along = -offsets[:, 2] / distance
        exponent = (1 - along) ** 2 / (2 * settings.sensing.sigma_axis**2)
        exponent += (distance - settings.sensing.distance_m) ** 2 / (2 * settings.sensing.sigma_distance_m**2)
        return np.where(exponent <= settings.sensing.exponent_cut, np.exp(-exponent), 0.0)

    xi1, xi2 = planner._certificate(pose)

    step = 1e-4
    rate = (share(step) - share(-step)) / (2 * step)
    barrier = share(0.0) - own.field.size * settings.planners.persistent_rate_per_s
    expected = rate + settings.controller.sampling_gain_per_s * barrier
    assert float(xi1 @ velocity) + xi2 == pytest.approx(expected, rel=1e-3, abs=1e-3 * np.abs(xi1).sum())


def test_what_another_drone_sees_is_not_one_s_own_share() -> None:
    planner, alone = persistent(), persistent()
    pose = np.array([0.4, 0.5, 2.0, 0.0, DOWN])
    beside = pose + np.array([0.3, 0.0, 0.0, 0.0, 0.0])
    planner.note_team([1, 2], np.array([pose, beside]))
    alone.note_team([1], pose[None])

    (xi1, _), (xi1_alone, _) = planner._certificate(pose), alone._certificate(pose)

    assert xi1[0] < xi1_alone[0] - 1.0, "the neighbour on the right takes what lies there"


# --- lawnmower ---------------------------------------------------------------------------------------------------


def test_a_lawnmower_sweeps_the_target_and_then_again_crosswise() -> None:
    flight = TeamFlight(mission("lawnmower", target=Target(lower_m=(-1.5, -1, 0), upper_m=(1.5, 1, 2), cell_rad=0.6)))
    (body,), (planner,) = flight.bodies, flight.planners
    assert isinstance(planner, Lawnmower)
    xs, ys = np.linspace(-1.5, 1.5, 31), np.linspace(-1, 1, 21)
    footprint = footprint_of(flight.mission.camera, flight.mission.sensing.distance_m)
    for axis in (0, 1):
        seen = np.zeros((len(xs), len(ys)), bool)
        travelled = np.zeros(2)
        while planner.passes == axis:
            assert flight.tick < 4000
            flight.step()
            assert planner.left_out == 0
            heading = body.velocity[:2]
            travelled += np.abs(heading)
            aligned = min(abs(body.pose[3] - axis * DOWN), abs(body.pose[3] + axis * DOWN)) < TURNED_RAD
            if aligned and body.pose[4] > DOWN - TURNED_RAD and abs(body.pose[2] - 2.0) < 0.05:
                offset = xs[:, None] - body.pose[0], ys[None] - body.pose[1]
                ahead, aside = offset[axis], offset[1 - axis]
                seen |= (np.abs(ahead) <= footprint.length_m / 2) & (np.abs(aside) <= footprint.width_m / 2)
        assert seen.all(), f"pass {axis + 1} left {(~seen).sum()} of {seen.size} points unseen"
        assert travelled[axis] > travelled[1 - axis], "along the strips more than across"


def test_a_waypoint_that_stays_out_of_reach_is_left_out_after_a_while() -> None:
    planner = Lawnmower(mission("lawnmower"), drone=1, neighbours=1)
    planner.decide(READY, STILL, [], TERMS, CELLS)
    pose = READY.copy()
    pose[3] = 0.0
    first, second = planner._way[0], planner._way[1]
    for _ in range(round(WAIT_S * 20) + 1):
        assert planner._way[0] is first
        planner.decide(pose, STILL, [], TERMS, CELLS)
    planner.decide(pose, STILL, [], TERMS, CELLS)

    assert planner._way[0] is second
    assert planner.left_out == 1


def test_a_lawnmower_may_sweep_a_target_that_is_wider_than_its_region() -> None:
    narrow = Flight(lower_m=(-1.0, -1.0, 0.5), upper_m=(1.0, 1.0, 5.0))
    planner = Lawnmower(mission("lawnmower", (0.0, 0.5, 2.0, 0.0, 1.3), flight=narrow), drone=1, neighbours=0)
    planner.decide(READY, STILL, [], TERMS, CELLS)

    assert np.abs(planner._way).max() == pytest.approx(1.0)


def test_the_sampling_that_is_reported_is_phi_s_whatever_a_planner_goes_by() -> None:
    team = Mission(
        controller=Controller(planner="lawnmower"),
        planners=Planners(overlap=0.3),
        drones=(Drone(id=1, start=(0, 1, 2, 0, 1.3)),),
    )
    decision = Lawnmower(team, drone=1, neighbours=0).decide(READY, STILL, [], TERMS, CELLS)

    assert decision.sampling == pytest.approx(3.0 * 20.0)
    assert decision.slack == 0.0


def test_somebody_who_stands_still_in_the_way_is_flown_around() -> None:
    planner = Lawnmower(mission("lawnmower"), drone=1, neighbours=1)
    pose = np.array([-2.5, -2.2, 2.0, 0.0, DOWN])
    planner.decide(pose, STILL, [], TERMS, CELLS)
    ahead = Neighbour(2, np.array([*(pose[:2] + np.array([1.5, 0.1])), 2.0]), 0.0)
    nearest = math.inf
    for _ in range(400):
        pose = pose + 0.05 * planner.decide(pose, STILL, [ahead], TERMS, CELLS).velocity
        nearest = min(nearest, math.dist(pose[:3], ahead.position))
    assert nearest >= 1.0
    assert pose[0] > ahead.position[0] + 0.5


def test_a_camera_that_sees_next_to_nothing_still_has_a_way_to_sweep() -> None:
    planner = Lawnmower(
        mission("lawnmower", sensing={"distance_m": 0.05}, target={"lower_m": (0, 0, 0), "upper_m": (1, 1, 2)}),
        drone=1,
        neighbours=0,
    )
    planner.decide(READY, STILL, [], TERMS, CELLS)

    assert 20 < len(planner._way) < 400
