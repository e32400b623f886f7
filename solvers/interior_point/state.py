"""State of the interior point between calls of its compiled functions, as plain arrays."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from unifg.elimination.plan import Plan
from unifg.problem.table import TermArrays
from unifg.problem.units import Units
from unifg.solution.optimality import NUMBERS
from unifg.typing import Array, IntArray, Records

# Scalars.
NOW = np.dtype(
    [
        ("mu", np.float64),
        ("rho", np.float64),
        ("tolerance", np.float64),
        ("theta", np.float64),  # sum of |h| and |c + e - s| at the present iterate
        ("phi", np.float64),  # barrier function there
        ("slope", np.float64),  # its derivative along the step
        ("alpha", np.float64),  # primal step length under trial
        ("alpha_dual", np.float64),
        ("theta_small", np.float64),
        ("theta_large", np.float64),
        ("theta_most", np.float64),  # largest theta_large that a restart may have
        ("delta", np.float64),  # shift of the Hessian's diagonal that the present direction needed
        ("last_delta", np.float64),  # the last one that was not zero
        ("cost", np.float64),
        ("stationarity", np.float64),
        ("violation", np.float64),
        ("excess", np.float64),  # violation in the units of the rows
        ("complementarity", np.float64),
        ("gap", np.float64),  # largest |h| and |c + e - s|
        ("least", np.float64),  # smallest product of a slack and its multiplier
        ("most", np.float64),  # largest
        ("forces", np.float64),  # what stationarity and complementarity are relative to
        ("finer", np.float64),  # share of the least mu
        ("step", np.float64),  # norm of the last step taken
        ("taken", np.float64),  # its length
        ("stuck_phi", np.float64),  # barrier function at that iteration
        ("stuck_theta", np.float64),  # theta there
        ("trial_cost", np.float64),
        ("saved_slope", np.float64),  # of the step that a correction replaces
        ("saved_alpha", np.float64),
        ("saved_dual", np.float64),
        ("asked", np.float64),  # penalty at which it was asked whether the violation is the least
        ("paid", np.float64),  # largest violation of a row times its penalty
        ("share", np.float64),  # of the second derivatives in the KKT matrix
        ("cost_unit", np.float64),  # what the objective is measured in: its size at the start
        ("size", np.float64),  # of the objective at the present iterate
        ("step_tolerance", np.float64),  # norm of a full step below which to stop, once the violation is small enough
        ("violation_tolerance", np.float64),
        ("suspicion", np.float64),  # size of the multipliers, as :mod:`unifg.solution.multipliers` has it
        ("feasible", np.float64),  # tolerance of the violation
        ("violation_unit", np.float64),  # of the rows in the mean, 0 where nothing tells it
        ("keeping", np.float64),  # violation up to which an iterate counts as one that keeps all constraints
        ("evaluating", np.float64),  # seconds of the solve in terms and their derivatives
        ("solving", np.float64),  # in linear systems
        ("judging", np.float64),  # in the KKT test of the answer
        ("clock", np.int64),  # address of the clock, 0 for none
        ("answer", np.int64),  # of the last call, one of the words below
        ("sides", np.int64),  # how many there are
        ("iteration", np.int64),
        ("limit", np.int64),
        ("exact", np.int64),  # whether to use second derivatives where they pay
        ("bending", np.int64),  # whether the present step does
        ("filtered", np.int64),  # pairs in the filter
        ("settled", np.int64),  # whether mu is the least
        ("trials", np.int64),
        ("corrected", np.int64),  # whether the trial is a second-order correction
        ("failures", np.int64),  # line searches in a row that found nothing
        ("gauss_newton", np.int64),  # whether the present direction used the Gauss-Newton Hessian
        ("definite", np.int64),  # whether the Hessian of Gauss-Newton is, one of the words below
        ("estimated", np.int64),  # whether a cold start has multipliers by least squares
        ("cold", np.int64),  # whether the start had no multipliers
        ("descent", np.int64),  # whether the last trial was accepted because it lowers the barrier function
        ("elastic", np.int64),  # whether equalities are elastic, as inequalities always are
        ("going_on", np.int64),  # whether slacks and multipliers are there: the solve goes on where it was
        ("clocked", np.int64),  # whether to ask before every direction if there is time for it
        ("violated", np.int64),  # whether a row is, by the tolerance or in its unit
        ("concluded", np.int64),  # whether the present iterate has been judged
        ("kept", np.int64),  # whether an iterate kept all constraints
        ("short_steps", np.int64),  # in a row
        ("restores", np.int64),  # whether to ask for a descent on the violation before equalities become elastic
        ("stuck", np.int64),  # iteration after which nothing has become better
        ("scaling", np.int64),  # whether units are to be found
        ("raises", np.int64),  # of the penalties
        ("assisted", np.int64),  # whether Python evaluates, linearises and bends
        ("watched", np.int64),  # whether somebody looks at every iterate
        ("stage", np.int64),  # where the loop goes on
    ]
)
# A finite limit of an inequality row.
SIDE = np.dtype(
    [
        ("row", np.int64),  # of the constraints
        ("sign", np.float64),  # +1 for a lower limit, -1 for an upper one
        ("border", np.float64),  # the limit
        ("y", np.float64),  # multiplier, between 0 and rho
        ("s", np.float64),  # slack
        ("e", np.float64),  # elastic variable
        ("dy", np.float64),
        ("ds", np.float64),
        ("de", np.float64),
        ("rest", np.float64),  # c + e - s of the present iterate, with corrections
        ("weight", np.float64),  # what the side adds to the Hessian
        ("saved_dy", np.float64),
        ("saved_ds", np.float64),
        ("saved_de", np.float64),
    ]
)
# What makes an equality row elastic, h = p - n.
PAIR = np.dtype(
    [
        ("p", np.float64),
        ("n", np.float64),
        ("dp", np.float64),
        ("dn", np.float64),
        ("saved_dp", np.float64),
        ("saved_dn", np.float64),
    ]
)
# Addresses of compiled functions.
FUNCTIONS = "factor solve linearize evaluate curve weigh add_scalars evaluate_scalars retract"
FUNCTIONS += " begin measure test bend direct assemble examine estimate steer advance judge correct restore accept"
FUNCTIONS += " relax increase_penalty renew loop reset split conclude solve_once kkt_numbers raise_slopes size_of"
LINKS = np.dtype([(name, np.int64) for name in FUNCTIONS.split()])

# What a call answers.
TRY, ACCEPTED, AGAIN, CONVERGED, LIMIT_REACHED, SINGULAR, STALLED, NOT_FINITE, VIOLATED, STOPPED = range(10)
# What the loop asks of Python, before it is called again.
LINEARIZE, BEND, EVALUATE, SHOW, RESTORE = range(10, 15)
# What is known of the Hessian of Gauss-Newton; while it is examined, the matrix is written without the sides.
UNKNOWN, YES, NO, EXAMINED = range(4)
# Where it goes on then.
MOVED, LINEARIZED, MEASURED, TESTED, BENT, AIMED, EVALUATED = range(7)
FILTER = 400  # pairs of theta and phi that are remembered


class Problem(NamedTuple):
    """Arrays of one structure that no iteration changes.

    Attributes:
        links: (1,) addresses of compiled functions.
        terms: of the program.
        plan: elimination of the KKT matrix, whose entries come in the order of ``Work.data``.
        retraction: its parts.
        free: columns that are unknown.
        fixed: places of stored values that stay.
        scratch: memory of the loops over terms.
        rows: (E,) equality rows.
        entries: entries of the constraint Jacobian behind those of the Hessian in ``Work.data``.
        doubles: (D, 2) places in ``Work.data`` that mean one entry of the matrix: the second is added to the first.
        unequal: (T,) whether a term has inequality rows.
        measures: units of the solve, found at its start.
        sizes: memory of the KKT test.
    """

    links: Records
    terms: TermArrays
    plan: Plan
    retraction: IntArray
    free: IntArray
    fixed: IntArray
    scratch: Array
    rows: IntArray
    entries: IntArray
    doubles: IntArray
    unequal: IntArray
    measures: Units
    sizes: Array


class Work(NamedTuple):
    """Arrays of the method with their shapes, whose words :func:`unifg.solvers.workspace.empty` is given.

    Attributes:
        scalars: (1,) of `NOW`.
        sides: (2 M,) one for each finite limit of an inequality row.
        pairs: (E,) one for each equality row.
        penalties: (M,) of the elastic variables of a row.
        row_units, units: (M,) what a row, and (width,) what an unknown, is measured in: those of ``measures``.
        kept: stored values of the last iterate that kept all constraints.
        values, trial: stored values of the present iterate and of a trial.
        move: (n,) tangent step to the trial.
        spread: (width,) the same over the full tangent space; or the gradient with the sides eliminated.
        full: (width,) gradient of the Lagrangian over the full tangent space.
        residual, jacobian, constraints, constraint_jacobian, gradient, hessian: as in a linearisation.
        curvature: ``hessian`` with second derivatives, where they are used.
        trial_residual, trial_constraints, trial_squares, trial_heights: at a trial.
        squares, weights: of robust factors, as in a linearisation.
        heights: (K,) values of all scalar costs.
        concavity: as in a linearisation, empty without scalar costs.
        norms: of the terms.
        steepest_jacobian, steepest_gradient: largest derivatives at starts and at the answer.
        kkt: numbers at the answer, as the outside judge has them.
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

    scalars: Annotated[Records, NOW, 1]
    sides: Annotated[Records, SIDE, "sides"]
    pairs: Annotated[Records, PAIR, "equalities"]
    penalties: Annotated[Array, "rows"]
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
    trial_squares: Annotated[Array, "robust"]
    trial_heights: Annotated[Array, "general"]
    squares: Annotated[Array, "robust"]
    weights: Annotated[Array, "robust"]
    heights: Annotated[Array, "general"]
    concavity: Annotated[Array, "concave"]
    norms: Annotated[Array, "terms"]
    steepest_jacobian: Annotated[Array, "row_entries"]
    steepest_gradient: Annotated[Array, "width"]
    kkt: Annotated[Array, NUMBERS]
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
