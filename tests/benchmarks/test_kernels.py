"""The two computations of a tick against their plain forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agents.barriers import Barriers, Neighbour, predicted_pose
from agents.planners.coverage import CoverageController
from agents.quadratic_program import QuadraticProgram
from faults.dense_field import dense_tick
from faults.measure import median_s
from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.mission import Drone, Mission, Sensing, Target
from sim_bridge.dynamics import VehicleBody

Record = Callable[..., None]
DT = 0.05
STARTS = ((0.0, 1.0, 2.0, 0.0, 1.3), (2.0, 1.0, 2.0, 1.0, 1.4), (-2.0, 1.0, 2.0, 2.0, 1.2), (0.0, -2.0, 2.0, 3.0, 1.3))


def test_field_tick(record: Record) -> None:
    """Decay of four drones and one drone's terms over 117,600 cells; the issue's bar is 100 times."""
    field, sensing, poses = VirtualField.of(Target()), Sensing(), np.array(STARTS)
    importance = ImportanceField(field, sensing)
    rows, directions = field.shape
    phi = np.ones(field.size)
    cells = field.positions().repeat(directions, axis=0)
    views = np.tile(field.directions, (rows, 1))
    gradient = dense_tick(phi, cells, views, poses, sensing, DT)
    terms = importance.advance(poses, DT, 0)
    assert np.allclose(terms.gradient, gradient, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())
    windowed = median_s(lambda: [importance.advance(poses, DT, 0) for _ in range(50)], 15) / 50
    dense = median_s(lambda: dense_tick(phi, cells, views, poses, sensing, DT), 7)
    record("field_tick_117600", windowed * 1e3, "ms CPU", "NumPy over all cells, as printed", dense / windowed)


def test_qp_solve(record: Record) -> None:
    """The QPs of a real flight: updated and warm-started against set up anew; the issue's bar is 20 times."""
    mission = Mission(drones=tuple(Drone(id=k + 1, start=start) for k, start in enumerate(STARTS)))
    problems = _problems_of_a_flight(mission, ticks=300)
    effort, rows = mission.controller.effort_weight, len(problems[0][2].names)
    kept = QuadraticProgram(rows, effort)

    def warm() -> None:
        for problem in problems:
            kept.solve(*problem)

    def anew() -> None:
        for problem in problems[::10]:
            QuadraticProgram(rows, effort).solve(*problem)

    updated = median_s(warm, 5) / len(problems)
    fresh = median_s(anew, 5) / len(problems[::10])
    record("qp_solve", updated * 1e6, "us CPU", "OSQP set up each tick", fresh / updated)


def _problems_of_a_flight(mission: Mission, ticks: int) -> list[tuple]:
    """(xi1, xi2, rows, low, high) of drone 1 over the first ticks of a mission of four."""
    flight, count = mission.flight, len(mission.drones)
    importance = [ImportanceField(VirtualField.of(mission.target), mission.sensing) for _ in range(count)]
    bodies = [VehicleBody.at(np.array(drone.start)) for drone in mission.drones]
    controllers = [CoverageController(mission, count - 1) for _ in range(count)]
    barriers = Barriers(mission)
    problems = []
    cells = np.full(count, importance[0].field.size / count)
    for tick in range(ticks):
        poses = np.array([body.pose for body in bodies])
        predicted = [predicted_pose(body.pose, body.velocity, flight) for body in bodies]
        for row, body in enumerate(bodies):
            terms = importance[row].advance(poses, DT, row)
            others = [Neighbour(k + 1, predicted[k][:3], 0.0) for k in range(count) if k != row]
            decision = controllers[row].decide(body.pose, body.velocity, others, terms, cells[row])
            if row == 0:
                decay = mission.sensing.decay_per_s
                xi2 = decay * terms.first - cells[0] * mission.controller.coverage_rate_per_s - decay**2 * terms.second
                problems.append(
                    (
                        decay * terms.gradient,
                        xi2,
                        barriers.rows(predicted[0], others),
                        *barriers.velocity_bounds(body.velocity),
                    )
                )
            body.command(decision.velocity, tick * DT, flight)
        for body in bodies:
            body.step(DT, tick * DT, flight)
    return problems
