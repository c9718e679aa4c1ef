"""One drone's quadratic program through OSQP: set up once, then updated and warm-started every tick.

    minimise   eps |u|^2 + w^2, |u_k - wish_k|^2 for every axis k that is held,
               and smoothing (|u|^2 + |u - flown|^2) where flight is to be smooth
    subject to xi1 . u + xi2 >= w      (sampling, the only row with slack)
               a_k . u >= b_k          (strict rows)
               low <= u <= high

The cells' importance makes xi1 and xi2 thousands of times larger than a velocity. So the solver sees v = (w - xi2) / s
with s of the size of xi1 . u, and the cost divided by |xi2| s: the same program, with coefficients near 1 - but for
eps, which nearly vanishes. It matters where the sampling row can be met, because then it alone chooses among all the
velocities that do; `EFFORT_FLOOR` keeps it from sinking below what the solver can tell from nothing.
The paper's controller holds no axis and smooths nothing. The baselines hold some, such as the height: softly, because
only the strict rows may make the program infeasible.
Its outcome is a value, never an exception.

Where rows of many obstacles meet near the best velocity the search may go on for ever. `SafetyFilter` asks such a
program once more with `SECOND_TRY`, whose curvature is larger: a worse velocity, within the same strict rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import osqp
import scipy.sparse as sparse
from numba import njit
from numpy.typing import NDArray

from agents.barriers import Rows
from protocol.geometry import Floats

Outcome = Literal["solved", "infeasible", "out_of_time", "numerical"]

TOLERANCE = 1e-5
"""Residual that the solver accepts, in m/s or rad/s; strict rows are tightened by as much, so it costs no safety."""
ACTIVE = 1e-3
"""A strict row or bound that is so near to equality, in m/s or rad/s, is reported as active."""
EFFORT_FLOOR = 3e-4
"""Least weight of |u|^2 in the scaled cost; TOLERANCE / EFFORT_FLOOR, 0.03 m/s, is how far u may be from the shortest.
Measured over flights of two and four drones: without it the velocities that met the sampling row were twice as long as
the shortest; with it they are within 1 %, and w is off by 1e-4 of xi2."""
HELD_WEIGHT = 1.0
"""Weight of |u_k - wish_k|^2 in the scaled cost, in which w weighs 2 at most: a held axis moves as wished to TOLERANCE,
unless a strict row is in the way."""
XI2_MAX = 10.0
"""With smoothing: size of xi2 in multiples of the most that a velocity contributes to the sampling row. Beyond 1 the
row is met whatever is flown, or never; beyond 10 it hardly matters to the velocity by how far, but the slack's weight
would go on falling until the solver cannot tell it from nothing."""
CHECK_EVERY = 5
"""Iterations between two tests of convergence; a warm start often needs no more."""
ADAPT_EVERY = 200
"""Iterations between two changes of the solver's step size. Measured over 15,000 programs of flights and at random: at
50 or 100 some cycled for ever, at 200 all were solved, in 80 iterations at the mean and 3430 at most."""
SMOOTH_STEP = 1.0
"""With smoothing: step size of the solver, which never changes: the cost is as curved along every input, so none need
be searched for, and where a search began it could cycle, at rows that nearly are a corner of the bounds."""
MAX_ITERATIONS = 4000
"""Some milliseconds. A bound in iterations, not in seconds, gives the same answer on a busy machine."""


@dataclass(frozen=True, slots=True)
class Search:
    """How the solver looks for the answer."""

    step: float | None = None
    """Its step size, if that is not to be adapted."""
    effort_floor: float = EFFORT_FLOOR


FIRST_TRY, SMOOTH = Search(), Search(step=SMOOTH_STEP)
SECOND_TRY = Search(step=0.3, effort_floor=0.05)
"""Of 112 programs of a flight in a furnished room that have an answer, 0.1 mm/s wide at least, and were not solved in
10,000 iterations, 107 are, in 800 at the median; what they contribute to the sampling row is up to 2 % of the most that
a velocity contributes from the best."""

_INFINITY = 1e30  # what the solver takes for no bound
_VARIABLES, _INPUTS = 6, 5
_SAMPLING, _BOUNDS, _STRICT = 0, 1, 6
_AXES = ("bound:x", "bound:y", "bound:z", "bound:yaw", "bound:pitch")
_OUTCOMES: dict[int, Outcome] = {
    osqp.SolverStatus.OSQP_SOLVED: "solved",
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: "infeasible",
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE: "infeasible",
    osqp.SolverStatus.OSQP_MAX_ITER_REACHED: "out_of_time",
}


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Axes that are to move as wished, and not as the sampling row asks."""

    axes: NDArray[np.bool_]
    """(5,)."""
    wish: Floats
    """(5,) m/s and rad/s; without a meaning on the other axes."""


NOTHING_HELD = Held(np.zeros(5, np.bool_), np.zeros(5))


@dataclass(frozen=True, slots=True, eq=False)
class Smoothing:
    """What speed and acceleration cost."""

    weight: float
    """Of |u|^2 + |u - flown|^2 in the scaled cost, in which w weighs 2 at most; 0: none. u - flown is the acceleration
    times the lag."""
    flown: Floats
    """(5,) m/s and rad/s."""


NOT_SMOOTH = Smoothing(0.0, np.zeros(5))


@dataclass(frozen=True, slots=True)
class Solution:
    outcome: Outcome
    velocity: Floats
    """(5,) u; meaningless unless solved."""
    slack: float
    """w, at most 0."""
    active: tuple[str, ...]
    """Names of the strict rows and bounds that hold with equality."""


@njit(cache=True, nogil=True)
def _length(coefficients: Floats, row: int) -> float:
    """Euclidean norm of one row; written out, because slices cost more than the sum."""
    square = 0.0
    for i in range(coefficients.shape[1]):
        square += coefficients[row, i] * coefficients[row, i]
    return max(math.sqrt(square), 1e-9)


@njit(cache=True, nogil=True)
def _merge_into_bounds(coefficients: Floats, lower: Floats, upper: Floats) -> None:
    """Strict rows about one input alone become its bounds, unless that would leave it nothing.

    Where two rows are parallel and nearly the same, such as the pitch's and its bound, the solver moved the multiplier
    from one to the other in ten thousand iterations, or let its step size grow and shrink for ever.
    """
    for k in range(coefficients.shape[0]):
        length = _length(coefficients, k)
        row = _STRICT + k
        for i in range(_INPUTS):
            share, limit = coefficients[k, i] / length, lower[row]
            if share == 1.0 and limit <= upper[_BOUNDS + i]:
                lower[_BOUNDS + i] = max(lower[_BOUNDS + i], limit)
                lower[row] = -_INFINITY
            elif share == -1.0 and -limit >= lower[_BOUNDS + i]:
                upper[_BOUNDS + i] = min(upper[_BOUNDS + i], -limit)
                lower[row] = -_INFINITY


@njit(cache=True, nogil=True)
def _fill(
    xi1: Floats,
    xi2: float,
    coefficients: Floats,
    bounds: Floats,
    low: Floats,
    high: Floats,
    held: NDArray[np.bool_],
    wish: Floats,
    smoothing: float,
    flown: Floats,
    effort: float,
    effort_floor: float,
    quadratic: Floats,
    linear: Floats,
    matrix: Floats,
    lower: Floats,
    upper: Floats,
) -> bool:
    """Write one program's numbers where the solver wants them; False if one of them is not finite.

    ``quadratic`` and ``linear`` (6,), ``lower`` and ``upper`` (rows,), and the columns of the constraint ``matrix``
    one after another: five with sampling, own bound and all strict rows, and the slack's with its single entry.
    """
    reach = 0.0
    for i in range(_INPUTS):
        reach += abs(xi1[i]) * max(-low[i], high[i])
    reach = max(1e-3, reach)
    if smoothing > 0:
        xi2 = min(max(xi2, -XI2_MAX * reach), XI2_MAX * reach)
    cost = reach * max(abs(xi2), reach)
    quadratic[:_INPUTS] = max(2 * effort / cost, effort_floor)
    for i in range(_INPUTS):
        linear[i] = 0.0
        if smoothing > 0:
            quadratic[i] += 4 * smoothing
            linear[i] = -2 * smoothing * flown[i]
        if held[i]:
            quadratic[i] = 2 * HELD_WEIGHT
            linear[i] = -2 * HELD_WEIGHT * wish[i]
    quadratic[_INPUTS] = 2 * reach * reach / cost
    linear[_INPUTS] = 2 * xi2 * reach / cost
    lower[_BOUNDS:_STRICT] = low
    upper[_BOUNDS:_STRICT] = high
    lower[_STRICT:] = -_INFINITY
    column = 2 + lower.size - _STRICT
    for i in range(_INPUTS):
        matrix[i * column] = xi1[i] / reach
        matrix[i * column + 2 : (i + 1) * column] = 0.0
    for k in range(bounds.size):
        # Scaled to unit length, a residual is a velocity whatever the row's unit.
        length = _length(coefficients, k)
        for i in range(_INPUTS):
            matrix[i * column + 2 + k] = coefficients[k, i] / length
        lower[_STRICT + k] = bounds[k] / length + TOLERANCE
    if smoothing > 0:
        _merge_into_bounds(coefficients, lower, upper)
    return bool(np.isfinite(matrix.sum() + lower.sum() + upper.sum() + linear.sum() + cost))


@njit(cache=True, nogil=True)
def _read(
    found: Floats, coefficients: Floats, bounds: Floats, low: Floats, high: Floats
) -> tuple[Floats, list[int], list[int]]:
    """The velocity (5,) within its bounds, and which strict rows and which inputs' bounds hold with equality."""
    velocity = np.empty(_INPUTS)
    limited = []
    for i in range(_INPUTS):
        velocity[i] = min(max(found[i], low[i]), high[i])
        if velocity[i] - low[i] < ACTIVE or high[i] - velocity[i] < ACTIVE:
            limited.append(i)
    tight = []
    for k in range(bounds.size):
        margin = -bounds[k]
        for i in range(_INPUTS):
            margin += coefficients[k, i] * velocity[i]
        if margin < ACTIVE * _length(coefficients, k):
            tight.append(k)
    return velocity, tight, limited


class QuadraticProgram:
    """Room for ``strict_rows`` strict rows; unused ones are switched off by infinite bounds."""

    def __init__(self, strict_rows: int, effort_weight: float, search: Search = FIRST_TRY) -> None:
        self.strict_rows = strict_rows
        self._effort, self._effort_floor = effort_weight, search.effort_floor
        rows = _STRICT + strict_rows
        # Every coefficient that may ever be non-zero has its place, so that only values change.
        pattern = np.zeros((rows, _VARIABLES))
        pattern[_SAMPLING] = 1.0
        pattern[_BOUNDS:_STRICT, :_INPUTS] = np.eye(_INPUTS)
        pattern[_STRICT:, :_INPUTS] = 1.0
        structure = sparse.csc_matrix(pattern)
        self._quadratic, self._linear = np.ones(_VARIABLES), np.zeros(_VARIABLES)
        self._matrix = np.ones(structure.nnz)
        self._matrix[-1] = -1.0
        self._low, self._high = np.full(rows, -_INFINITY), np.full(rows, _INFINITY)
        self._low[_SAMPLING] = 0.0
        self._solver = osqp.OSQP()
        self._solver.setup(
            sparse.eye(_VARIABLES, format="csc"),
            self._linear,
            structure,
            self._low,
            self._high,
            verbose=False,
            eps_abs=TOLERANCE,
            eps_rel=0.0,
            max_iter=MAX_ITERATIONS,
            check_termination=CHECK_EVERY,
            adaptive_rho_interval=ADAPT_EVERY,
            polishing=False,
            **({} if search.step is None else {"adaptive_rho": False, "rho": search.step}),
        )

    def solve(
        self,
        xi1: Floats,
        xi2: float,
        rows: Rows,
        low: Floats,
        high: Floats,
        held: Held = NOTHING_HELD,
        smoothing: Smoothing = NOT_SMOOTH,
    ) -> Solution:
        """``xi1`` (5,) and ``xi2`` of the sampling row; strict ``rows``; bounds ``low``, ``high`` (5,) of u.

        ``xi1`` is 0 along ``held`` axes, or the sampling row would pull at them.

        Raises:
            ValueError: there are more rows than room.
        """
        if len(rows.names) > self.strict_rows:
            raise ValueError(f"{len(rows.names)} strict rows, but room for {self.strict_rows}")
        finite = _fill(
            xi1,
            xi2,
            rows.coefficients,
            rows.bounds,
            low,
            high,
            held.axes,
            held.wish,
            smoothing.weight,
            smoothing.flown,
            self._effort,
            self._effort_floor,
            self._quadratic,
            self._linear,
            self._matrix,
            self._low,
            self._high,
        )
        if not finite:  # the solver would start its next search from what is no number
            return Solution("numerical", np.zeros(_INPUTS), 0.0, ())
        # The wrapper around the solver copies every statistic into Python objects, at several times the solver's time.
        solver = self._solver._solver  # noqa: SLF001
        solver.update_data_vec(q=self._linear, l=self._low, u=self._high)
        solver.update_data_mat(P_x=self._quadratic, P_i=None, A_x=self._matrix, A_i=None)
        solver.solve()
        outcome = _OUTCOMES.get(solver.info.status_val, "numerical")
        found = np.array(solver.solution.x)
        if outcome != "solved" or not np.isfinite(found).all():
            return Solution("numerical" if outcome == "solved" else outcome, np.zeros(_INPUTS), 0.0, ())
        velocity, tight, limited = _read(found, rows.coefficients, rows.bounds, low, high)
        active = [rows.names[k] for k in tight] + [_AXES[i] for i in limited]
        return Solution("solved", velocity, min(0.0, float(xi1 @ velocity) + xi2), tuple(active))
