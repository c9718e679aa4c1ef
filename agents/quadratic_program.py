"""One drone's quadratic program through OSQP: set up once, then updated and warm-started every tick.

    minimise   eps |u|^2 + w^2
    subject to xi1 . u + xi2 >= w      (sampling, the only row with slack)
               a_k . u >= b_k          (strict rows)
               low <= u <= high

The cells' importance makes xi1 and xi2 thousands of times larger than a velocity. So the solver sees v = (w - xi2) / s
with s of the size of xi1 . u, and the cost divided by |xi2| s: the same program, with coefficients near 1.
Its outcome is a value, never an exception.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import osqp
import scipy.sparse as sparse

from agents.barriers import Rows
from protocol.geometry import Floats

Outcome = Literal["solved", "infeasible", "out_of_time", "numerical"]

TOLERANCE = 1e-4
"""Residual that the solver accepts, in m/s or rad/s; strict rows are tightened by as much, so it costs no safety."""
ACTIVE = 1e-3
"""A row whose left side is so near its bound, in the row's own unit, is reported as active."""
CHECK_EVERY = 5
"""Iterations between two tests of convergence; a warm start often needs no more."""
MAX_ITERATIONS = 4000
"""About a millisecond. A bound in iterations, not in seconds, gives the same answer on a busy machine."""

_SAMPLING, _BOUNDS, _STRICT = 0, 1, 6
_INFINITY = 1e30  # what the solver takes for no bound
_AXES = ("bound:x", "bound:y", "bound:z", "bound:yaw", "bound:pitch")
_OUTCOMES: dict[int, Outcome] = {
    osqp.SolverStatus.OSQP_SOLVED: "solved",
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: "infeasible",
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE: "infeasible",
    osqp.SolverStatus.OSQP_MAX_ITER_REACHED: "out_of_time",
}


@dataclass(frozen=True, slots=True)
class Solution:
    outcome: Outcome
    velocity: Floats
    """(5,) u; meaningless unless solved."""
    slack: float
    """w, at most 0."""
    active: tuple[str, ...]
    """Names of the strict rows and bounds that hold with equality."""


class QuadraticProgram:
    """Room for ``strict_rows`` strict rows; unused ones are switched off by infinite bounds."""

    def __init__(self, strict_rows: int, effort_weight: float) -> None:
        self._effort = effort_weight
        rows = _STRICT + strict_rows
        # Every coefficient that may ever be non-zero has its place, so that only values change.
        pattern = np.zeros((rows, 6), bool)
        pattern[_SAMPLING] = True
        pattern[_BOUNDS:_STRICT, :5] = np.eye(5, dtype=bool)
        pattern[_STRICT:, :5] = True
        self._pattern = pattern.T.copy()  # column by column, as the solver stores it
        self._matrix = np.zeros((rows, 6))
        self._matrix[_SAMPLING, 5] = -1.0
        self._matrix[_BOUNDS:_STRICT, :5] = np.eye(5)
        self._low = np.full(rows, -_INFINITY)
        self._high = np.full(rows, _INFINITY)
        self._low[_SAMPLING] = 0.0
        self._weights, self._linear = np.ones(6), np.zeros(6)
        self._solver = osqp.OSQP()
        self._solver.setup(
            sparse.eye(6, format="csc"),
            np.zeros(6),
            sparse.csc_matrix(pattern.astype(float)),
            self._low,
            self._high,
            verbose=False,
            eps_abs=TOLERANCE,
            eps_rel=0.0,
            max_iter=MAX_ITERATIONS,
            check_termination=CHECK_EVERY,
            polishing=False,
        )

    def solve(self, xi1: Floats, xi2: float, rows: Rows, low: Floats, high: Floats) -> Solution:
        """``xi1`` (5,) and ``xi2`` of the sampling row; strict ``rows``; bounds ``low``, ``high`` (5,) of u."""
        reach = max(1e-3, 0.5 * float(np.abs(xi1).sum()))
        cost = reach * max(abs(xi2), reach)
        self._matrix[_SAMPLING, :5] = xi1 / reach
        self._low[_BOUNDS:_STRICT], self._high[_BOUNDS:_STRICT] = low, high
        # Scaled to unit length, a residual is a velocity whatever the row's unit.
        lengths = np.maximum(np.sqrt((rows.coefficients * rows.coefficients).sum(axis=1)), 1e-9)
        last = _STRICT + len(rows.names)
        self._matrix[_STRICT:last, :5] = rows.coefficients / lengths[:, None]
        self._low[_STRICT:last] = rows.bounds / lengths + TOLERANCE
        self._matrix[last:] = 0.0
        self._low[last:] = -_INFINITY
        self._weights[:5] = 2 * self._effort / cost
        self._weights[5] = 2 * reach * reach / cost
        self._linear[5] = 2 * xi2 * reach / cost
        # The wrapper around the solver copies every statistic into Python objects, at several times the solver's time.
        solver = self._solver._solver
        solver.update_data_vec(q=self._linear, l=self._low, u=self._high)
        solver.update_data_mat(P_x=self._weights, P_i=None, A_x=self._matrix.T[self._pattern], A_i=None)
        solver.solve()
        outcome = _OUTCOMES.get(solver.info.status_val, "numerical")
        found = np.array(solver.solution.x)
        if outcome != "solved" or not np.isfinite(found).all():
            return Solution("numerical" if outcome == "solved" else outcome, np.zeros(5), 0.0, ())
        velocity = np.clip(found[:5], low, high)
        tight = np.flatnonzero(rows.coefficients @ velocity - rows.bounds < ACTIVE)
        limits = np.flatnonzero((velocity - low < ACTIVE) | (high - velocity < ACTIVE))
        active = [rows.names[k] for k in tight] + [_AXES[k] for k in limits]
        return Solution("solved", velocity, min(0.0, float(xi1 @ velocity) + xi2), tuple(active))
