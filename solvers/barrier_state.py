"""What the interior point remembers between the calls of :mod:`unifg.solvers.barrier`, as plain arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.elimination.plan import Plan
from unifg.program.table import Terms
from unifg.typing import Array, IntArray

# Places in Work.numbers.
(
    MU,
    RHO,
    TOLERANCE,
    THETA,  # sum of |h| and |c + e - s| at the present iterate
    PHI,  # barrier function there
    SLOPE,  # its derivative along the step
    ALPHA,  # primal step length under trial
    ALPHA_DUAL,
    THETA_SMALL,
    THETA_LARGE,
    DELTA,  # shift of the Hessian's diagonal that the present direction needed
    LAST_DELTA,  # the last one that was not zero
    COST,
    STATIONARITY,
    VIOLATION,
    COMPLEMENTARITY,
    GAP,  # largest |h| and |c + e - s|
    LEAST,  # smallest product of a slack and its multiplier
    MOST,  # largest
    SCALE,  # of stationarity and complementarity
    STEP,  # norm of the last step taken
    TAKEN,  # its length
    TRIAL_COST,
    SAVED_SLOPE,  # of the step that a correction replaces
    SAVED_ALPHA,
    SAVED_DUAL,
    ASKED,  # price at which it was asked whether the violation is the least
    PAID,  # largest violation of a row times its price
    FORCE,  # stationarity in the units of the unknowns
    COST_UNIT,  # what the objective is measured in
    FLOATS,
) = range(31)
# Places in Work.counts.
(
    ANSWER,  # of the last call, one of the words below
    SIDES,  # how many there are
    ITERATION,
    LIMIT,
    EXACT,  # whether to use second derivatives
    FILTERED,  # pairs in the filter
    TRIALS,
    CORRECTED,  # whether the trial is a second-order correction
    FAILURES,  # line searches in a row that found nothing
    GAUSS_NEWTON,  # whether the present direction used the Gauss-Newton Hessian
    COLD,  # whether the start had no multipliers
    DESCENT,  # whether the last trial was accepted because it lowers the barrier function
    ELASTIC,  # whether equalities are elastic, as inequalities always are
    GOING_ON,  # whether slacks and multipliers are there: the solve goes on where it was
    KEPT,  # whether an iterate kept all constraints
    SHORT_STEPS,  # in a row
    SCALING,  # whether units are to be found
    RAISES,  # of the prices
    INTEGERS,
) = range(19)
# Rows of Work.sides.
(
    SIGN,  # +1 for a lower limit, -1 for an upper one
    BORDER,  # the limit
    Y,  # multiplier, between 0 and rho
    S,  # slack
    E,  # elastic variable
    DY,
    DS,
    DE,
    REST,  # c + e - s of the present iterate, with corrections
    WEIGHT,  # what the side adds to the Hessian
    SAVED_DY,
    SAVED_DS,
    SAVED_DE,
    SIDE_ROWS,
) = range(14)

# Rows of Work.pairs: what makes an equality row elastic, h = p - n.
(
    P,
    N,
    DP,
    DN,
    SAVED_DP,
    SAVED_DN,
    PAIR_ROWS,
) = range(7)

# What a call answers.
TRY, ACCEPTED, AGAIN, CONVERGED, LIMIT_REACHED, SINGULAR, STALLED, NOT_FINITE, VIOLATED = range(9)
# Places in Problem.links.
(
    FACTOR, SOLVE, LINEARIZE, EVALUATE, CURVE, RETRACT, BEGIN, MEASURE, TEST, DIRECT, STEER, ADVANCE, JUDGE, CORRECT,
    RESTORE, ACCEPT, RELAX, LOOP, LINKS,
) = range(19)  # fmt: skip

FILTER = 400  # pairs of theta and phi that are remembered


class Problem(NamedTuple):
    """What one structure needs and no iteration changes.

    Attributes:
        links: addresses of compiled functions, by the names above.
        terms: of the program.
        plan: elimination of the KKT matrix, whose entries come in the order of ``Work.data``.
        retraction: its parts.
        free: columns that are unknown.
        scratch: memory of the loops over terms.
        rows: (E,) equality rows.
        entries: entries of the constraint Jacobian behind those of the Hessian in ``Work.data``.
        doubles: (D, 2) places in ``Work.data`` that mean one entry of the matrix: the second is added to the first.
        unequal: (T,) whether a term has inequality rows.
    """

    links: IntArray
    terms: Terms
    plan: Plan
    retraction: IntArray
    free: IntArray
    scratch: Array
    rows: IntArray
    entries: IntArray
    doubles: IntArray
    unequal: IntArray


class Work(NamedTuple):
    """What the method remembers.

    Attributes:
        numbers, counts: scalars, by the names above.
        sides: (SIDE_ROWS, 2 M) one column for each finite limit of an inequality row.
        side_row: (2 M,) its row.
        pairs: (PAIR_ROWS, E) one column for each equality row.
        prices: (M,) of the elastic variables of a row.
        row_units, units: (M,) what a row, and (width,) what an unknown, is measured in.
        kept: stored values of the last iterate that kept all constraints.
        values, trial: stored values of the present iterate and of a trial.
        move: (n,) tangent step to the trial.
        spread: (width,) the same over the full tangent space.
        full: (width,) gradient of the Lagrangian over the full tangent space.
        residual, jacobian, constraints, constraint_jacobian, gradient, hessian: as in a linearisation.
        curvature: ``hessian`` with second derivatives, where they are used.
        trial_residual, trial_constraints: at a trial.
        squares, norms: not used, but written.
        multipliers: (M,) of the rows, positive at an upper limit.
        rests: (M,) residuals of equality rows, with corrections.
        row_weights, row_terms: (M,) what the sides of a row add to the Hessian and to the gradient.
        step: (n + E,) Newton step, unknowns then equality multipliers.
        saved: (n + E,) the step that a correction replaces.
        right: (n + E,) right-hand side.
        shift: (n + E,) what is added to the diagonal.
        data: Hessian with the sides eliminated, then equality Jacobian.
        filter: (FILTER, 2) pairs of theta and phi.
        log: (iterations, 9) history.
    """

    numbers: Array
    counts: IntArray
    sides: Array
    side_row: IntArray
    pairs: Array
    prices: Array
    row_units: Array
    units: Array
    kept: Array
    values: Array
    trial: Array
    move: Array
    spread: Array
    full: Array
    residual: Array
    jacobian: Array
    constraints: Array
    constraint_jacobian: Array
    gradient: Array
    hessian: Array
    curvature: Array
    trial_residual: Array
    trial_constraints: Array
    squares: Array
    norms: Array
    multipliers: Array
    rests: Array
    row_weights: Array
    row_terms: Array
    step: Array
    saved: Array
    right: Array
    shift: Array
    data: Array
    filter: Array
    log: Array


def empty_work(
    stored: int, width: int, unknowns: int, equalities: int, rows: tuple[int, int], entries: tuple[int, int],
    normal: int, terms: int, robust: int, iterations: int, data: int,
) -> Work:  # fmt: skip
    """Arrays of the right sizes, all zero.

    Args:
        stored: numbers that store the variables.
        width: full tangent columns.
        unknowns: those that are unknown.
        equalities: equality rows.
        rows: of costs and of constraints.
        entries: of their Jacobians.
        normal: of the Hessian.
        terms: how many there are.
        robust: robust factors.
        iterations: that the history has to hold.
        data: entries of the KKT matrix.
    """
    total, constraints = unknowns + equalities, rows[1]
    return Work(
        numbers=np.zeros(FLOATS),
        counts=np.zeros(INTEGERS, dtype=np.int64),
        sides=np.zeros((SIDE_ROWS, max(2 * constraints, 1))),
        side_row=np.zeros(max(2 * constraints, 1), dtype=np.int64),
        pairs=np.zeros((PAIR_ROWS, max(equalities, 1))),
        prices=np.zeros(constraints),
        row_units=np.ones(constraints),
        units=np.ones(width),
        kept=np.zeros(stored),
        values=np.zeros(stored),
        trial=np.zeros(stored),
        move=np.zeros(unknowns),
        spread=np.zeros(width),
        full=np.zeros(width),
        residual=np.zeros(rows[0]),
        jacobian=np.zeros(entries[0]),
        constraints=np.zeros(constraints),
        constraint_jacobian=np.zeros(entries[1]),
        gradient=np.zeros(width),
        hessian=np.zeros(normal),
        curvature=np.zeros(normal),
        trial_residual=np.zeros(rows[0]),
        trial_constraints=np.zeros(constraints),
        squares=np.zeros(robust),
        norms=np.zeros(terms),
        multipliers=np.zeros(constraints),
        rests=np.zeros(constraints),
        row_weights=np.zeros(constraints),
        row_terms=np.zeros(constraints),
        step=np.zeros(total),
        saved=np.zeros(total),
        right=np.zeros(total),
        shift=np.zeros(total),
        data=np.zeros(data),
        filter=np.zeros((FILTER, 2)),
        log=np.zeros((iterations + 2, 9)),
    )
