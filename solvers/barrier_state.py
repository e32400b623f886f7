"""What the interior point remembers between the calls of :mod:`unifg.solvers.barrier`, as plain arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.typing import Array, IntArray

# Places in Work.numbers.
(
    MU,
    RHO,
    TOLERANCE,
    THETA,  # sum of |h| at the present iterate
    PHI,  # barrier function there
    SLOPE,  # its derivative along dx
    ALPHA,  # primal step length under trial
    ALPHA_DUAL,
    THETA_SMALL,
    THETA_LARGE,
    DELTA,  # last shift of the Hessian's diagonal that was needed
    COST,
    STATIONARITY,
    VIOLATION,
    COMPLEMENTARITY,
    STEP,  # norm of the last step taken
    TAKEN,  # its length
    FLOATS,
) = range(18)
# Places in Work.counts.
(
    ITERATION,
    LIMIT,
    EXACT,  # whether to use second derivatives
    FILTERED,  # pairs in the filter
    TRIALS,
    CORRECTED,  # whether the trial is a second-order correction
    FAILURES,  # line searches in a row that found nothing
    GAUSS_NEWTON,  # whether the present direction used the Gauss-Newton Hessian
    INTEGERS,
) = range(9)

# What a call answers.
TRY, ACCEPTED, AGAIN, CONVERGED, LIMIT_REACHED, SINGULAR, STALLED, NOT_FINITE = range(8)

FILTER = 400  # pairs of theta and phi that are remembered


class Iterate(NamedTuple):
    """The point the next step starts from.

    Attributes:
        cost: (1,) objective.
        residual, jacobian, constraints, constraint_jacobian, gradient, hessian: as in a linearisation.
        curvature: ``hessian`` with second derivatives, where they are used.
    """

    cost: Array
    residual: Array
    jacobian: Array
    constraints: Array
    constraint_jacobian: Array
    gradient: Array
    hessian: Array
    curvature: Array


class Work(NamedTuple):
    """Everything else the method remembers.

    Attributes:
        numbers, counts: scalars, by the names above.
        side_row, side_sign, side_limit: (K,) row, +1 for a lower limit and -1 for an upper one, and the limit.
        y, dy, s, e: (K,) multipliers, their steps, and slacks.
        multipliers: (M,) of the rows, positive at an upper limit.
        step: (n + E,) last Newton step, unknowns then equality multipliers.
        corrected: (n + E,) its second-order correction.
        right: (n + E,) right-hand side.
        shift: (n + E,) what is added to the diagonal.
        data: entries of the KKT matrix.
        matrix: entries of the Hessian with the sides eliminated.
        row_weights, row_terms, row_moves: (M,) workspace.
        full: workspace over the full tangent space.
        filter: (FILTER, 2) pairs of theta and phi.
        free: columns that are unknown.
        log: (iterations, 9) history.
    """

    numbers: Array
    counts: IntArray
    side_row: IntArray
    side_sign: Array
    side_limit: Array
    y: Array
    dy: Array
    s: Array
    e: Array
    multipliers: Array
    step: Array
    corrected: Array
    right: Array
    shift: Array
    data: Array
    matrix: Array
    row_weights: Array
    row_terms: Array
    row_moves: Array
    full: Array
    filter: Array
    free: IntArray
    log: Array


def empty_work(
    program_size: int, rows: int, width: int, entries: int, matrix: int, iterations: int
) -> dict[str, Array]:
    """Arrays of the right sizes, all zero; the sides come with each solve."""
    total = program_size
    return {
        "step": np.zeros(total),
        "corrected": np.zeros(total),
        "right": np.zeros(total),
        "shift": np.zeros(total),
        "data": np.zeros(entries),
        "matrix": np.zeros(matrix),
        "row_weights": np.zeros(rows),
        "row_terms": np.zeros(rows),
        "row_moves": np.zeros(rows),
        "full": np.zeros(width),
        "filter": np.zeros((FILTER, 2)),
        "log": np.zeros((iterations + 2, 9)),
    }
