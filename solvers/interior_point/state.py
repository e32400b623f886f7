"""What the interior point remembers between the calls of its compiled functions, as plain arrays."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np

from unifg.elimination.plan import Plan
from unifg.program.table import TermArrays
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
    STEP_TOLERANCE,  # norm of a full step below which to stop, once the violation is small enough
    VIOLATION_TOLERANCE,
    FLOATS,
) = range(33)
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
TRY, ACCEPTED, AGAIN, CONVERGED, LIMIT_REACHED, SINGULAR, STALLED, NOT_FINITE, VIOLATED, STOPPED = range(10)
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
    """

    links: IntArray
    terms: TermArrays
    plan: Plan
    retraction: IntArray
    free: IntArray
    scratch: Array
    rows: IntArray
    entries: IntArray
    doubles: IntArray


class Work(NamedTuple):
    """What the method remembers; each array with its shape, whose words :func:`empty_work` is told.

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
        spread: (width,) the same over the full tangent space; or the gradient with the sides eliminated.
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

    numbers: Annotated[Array, FLOATS]
    counts: Annotated[IntArray, INTEGERS]
    sides: Annotated[Array, SIDE_ROWS, "sides"]
    side_row: Annotated[IntArray, "sides"]
    pairs: Annotated[Array, PAIR_ROWS, "equalities"]
    prices: Annotated[Array, "rows"]
    row_units: Annotated[Array, "rows"]
    units: Annotated[Array, "width"]
    kept: Annotated[Array, "stored"]
    values: Annotated[Array, "stored"]
    trial: Annotated[Array, "stored"]
    move: Annotated[Array, "unknowns"]
    spread: Annotated[Array, "width"]
    full: Annotated[Array, "width"]
    residual: Annotated[Array, "residuals"]
    jacobian: Annotated[Array, "entries"]
    constraints: Annotated[Array, "rows"]
    constraint_jacobian: Annotated[Array, "row_entries"]
    gradient: Annotated[Array, "width"]
    hessian: Annotated[Array, "normal"]
    curvature: Annotated[Array, "normal"]
    trial_residual: Annotated[Array, "residuals"]
    trial_constraints: Annotated[Array, "rows"]
    squares: Annotated[Array, "robust"]
    norms: Annotated[Array, "terms"]
    multipliers: Annotated[Array, "rows"]
    rests: Annotated[Array, "rows"]
    row_weights: Annotated[Array, "rows"]
    row_terms: Annotated[Array, "rows"]
    step: Annotated[Array, "total"]
    saved: Annotated[Array, "total"]
    right: Annotated[Array, "total"]
    shift: Annotated[Array, "total"]
    data: Annotated[Array, "data"]
    filter: Annotated[Array, FILTER, 2]
    log: Annotated[Array, "log", 9]


def empty_work(**sizes: int) -> Work:
    """Arrays of the shapes that :class:`Work` gives them, all zero; ``sizes`` says what the words in them mean."""
    arrays: dict[str, Any] = {}
    for name, hint in get_type_hints(Work, include_extras=True).items():
        shape = [sizes[size] if isinstance(size, str) else size for size in hint.__metadata__]
        arrays[name] = np.zeros(shape, dtype=np.int64 if hint.__origin__ == IntArray else np.float64)
    return Work(**arrays)
