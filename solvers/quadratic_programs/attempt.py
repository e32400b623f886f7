"""One step of SQP, compiled: subproblem, merit, line search and the linearisation where it ends.

Python is asked for what only it can do: a subproblem for another route than the graph, or one that the graph does not
answer well; a second-order correction; terms without a kernel.

The merit is the cost plus a penalty per unit of violation for every row (Powell, A fast algorithm for nonlinearly
constrained optimization calculations, 1978), which stays above the multiplier of its row. A step is tried in full,
corrected for curved constraints, then halved until it meets Armijo's condition.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from unifg.codegen.function_pointers import number, run
from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to, dot
from unifg.problem.evaluation import times, transposed_times
from unifg.problem.linearization import all_finite
from unifg.problem.table import TermArrays
from unifg.solution.optimality import NUMBERS
from unifg.solvers.globalize.line_search import SHORTEST
from unifg.solvers.globalize.merit import ARMIJO
from unifg.solvers.globalize.norms import norm
from unifg.solvers.quadratic_programs.graph_route import PATIENCE, TIGHTEST, Stacked, list_sides, multiply
from unifg.solvers.quadratic_programs.scaling import Patterns
from unifg.solvers.quadratic_programs.subproblem import leaves_most
from unifg.typing import Array, BoolArray, IntArray, Records

NOISE, ROUNDING = 1e-8, 1e-13  # of the merit: for each unit of the penalty, and relative
SECANT_MATTERS = 0.5  # of the known curvature; less only slows convergence down
SHORTEST_SECANT = 1e-7  # below it, differences of gradients are rounding

NOW = np.dtype(
    [
        ("stage", np.int64),  # where to go on
        ("answer", np.int64),  # of the last call, one of the words below
        ("assisted", np.int64),  # whether Python evaluates and linearises
        ("least_squares", np.int64),  # whether the cost has no unit
        ("full_steps", np.int64),  # whether every step is taken in full
        ("correcting", np.int64),  # whether to ask for corrections
        ("corrected", np.int64),  # 1 while the trial is a correction, 2 once it was refused
        ("moved", np.int64),  # whether the last trial is the present iterate
        ("patience", np.int64),  # of the search for active sides
        ("iterations", np.int64),  # of the subproblem's method
        ("damping", np.float64),  # of the Hessian, in scaled units
        ("accuracy", np.float64),  # asked of the subproblem
        ("tolerance", np.float64),  # of the KKT test
        ("farthest", np.float64),  # scaled violation that no step may exceed
        ("error", np.float64),  # of the subproblem's answer
        ("cost", np.float64),
        ("trial_cost", np.float64),
        ("next_cost", np.float64),
        ("here", np.float64),  # merit
        ("slope", np.float64),  # bound of its derivative along the step
        ("slack", np.float64),  # what counts as rounding
        ("length", np.float64),  # share of the step under trial
        ("size", np.float64),  # norm of the step as taken
        ("missing", np.float64),  # curvature seen along the last steps that the Hessian lacked
        ("next_damping", np.float64),  # that the lengths of the last steps suggest
        ("exact", np.int64),  # whether Hessians are those of the Lagrangian
        ("curved", np.int64),  # whether that of the present subproblem is
        ("alone", np.int64),  # whether to go on after a step: what follows is for that
        ("budget", np.int64),  # steps after which Python has a look
        ("iteration", np.int64),
        ("limit", np.int64),  # iterations before giving up
        ("logged", np.int64),  # iterates in the log
        ("scaling", np.int64),  # whether units may be needed
        ("step_tolerance", np.float64),
        ("violation_tolerance", np.float64),
        ("feasible", np.float64),  # tolerance of the violation
        ("violation_unit", np.float64),  # of the rows in the mean, 0 where nothing tells it
        ("clock", np.int64),  # address of the clock, 0 for none
    ]
)
# What a call answers.
TAKEN, REFUSED, SOLVE, CORRECT, EVALUATE, LINEARIZE, STARTED, STOPPED = range(8)
# Where it goes on then.
POSED, SOLVED, AIMED, EVALUATED, LINEARIZED, MISSED, UNBEGUN = range(7)
LOGGED = 24  # iterates that the log holds

FIRST_DAMPING = 1e-3
DAMPING_GROWTH = 10.0
EXACT_GROWTH = 4.0  # by more, steps are damped too much and too little in turn
DAMPING_DECAY = 0.9  # faster forgetting cycles between overshooting and damped steps
SECANT_DECAY = 0.3  # of curvature that was seen along an earlier step
EXACT_DECAY = 0.5  # the exact Hessian leaves less to cycle about
LARGEST_DAMPING = 1e12
SMALLEST_DAMPING = 1e-9  # keeps H positive definite without showing in the step


class Problem(NamedTuple):
    """Arrays that no iteration changes.

    Attributes:
        links: addresses of compiled functions, in the order of :data:`LINKED`.
        terms: of the program.
        system: the KKT matrix with the equalities held.
        diagonal: of the Hessian, in the order of ``CompiledProblem.normal``.
        equality: (M,) which rows are.
        retraction: its parts.
        free: columns that are unknown.
        fixed: places of stored values that stay.
        fixed_values: what they are.
        scratch: memory of the loops over terms.
        bounded: places of stored values with a bound.
        bounds: the row of each of them.
        units: patterns that units are found from.
        coordinates: (width,) number of the coordinate of a family that each column belongs to.
        sizes: (coordinates,) memory of the KKT test.
    """

    links: IntArray
    terms: TermArrays
    system: Stacked
    diagonal: IntArray
    equality: BoolArray
    retraction: IntArray
    free: IntArray
    fixed: IntArray
    fixed_values: Array
    scratch: Array
    bounded: IntArray
    bounds: IntArray
    units: Patterns
    coordinates: IntArray
    sizes: Array


LINKED = ("minimize", "retract", "evaluate", "evaluate_scalars", "linearize", "add_scalars", "find_units")
MINIMIZE, RETRACT, VALUE, SCALARS, LINEAR, ADD_SCALARS, FIND_UNITS = range(len(LINKED))


class Work(NamedTuple):
    """Memory of an attempt.

    Attributes:
        scalars: (1,) of `NOW`.
        columns, rows: (n,) and (M,) factors of scaled units.
        penalties: (M,) of the merit.
        multipliers: (M,) of the present iterate, then those of the step that was taken.
        step, dual: (n,) and (M,) answer of the subproblem.
        bent, bent_dual: the same of a correction.
        taken: (n,) step as tried.
        linear: (M,) A times the step.
        measured: (2,) error of the graph's answer, and whether active sides were looked for in vain.
        bend: (M,) by how much constraints bend along the full step.
        full: (width,) memory.
        values, constraints, constraint_jacobian, gradient, hessian, weights: at the present iterate.
        trial: stored values of a trial.
        residual, next_constraints, squares, heights: there; all as in a linearisation.
        jacobian, next_jacobian, next_gradient, next_hessian, next_weights, norms, concavity: there, where it is taken.
        kkt: numbers of the iterate that was logged last, as the outside judge has them.
        steepest_jacobian, steepest_gradient: largest derivatives at iterates that were logged.
        log: iterates of a loop that runs alone, see :mod:`unifg.solvers.quadratic_programs.loop`.
    """

    scalars: Annotated[Records, NOW, 1]
    columns: Annotated[Array, "unknowns"]
    rows: Annotated[Array, "rows"]
    penalties: Annotated[Array, "rows"]
    multipliers: Annotated[Array, "rows"]
    step: Annotated[Array, "unknowns"]
    dual: Annotated[Array, "rows"]
    bent: Annotated[Array, "unknowns"]
    bent_dual: Annotated[Array, "rows"]
    taken: Annotated[Array, "unknowns"]
    linear: Annotated[Array, "rows"]
    measured: Annotated[Array, 2]
    bend: Annotated[Array, "rows"]
    full: Annotated[Array, "width"]
    values: Annotated[Array, "stored"]
    constraints: Annotated[Array, "rows"]
    constraint_jacobian: Annotated[Array, "row_entries"]
    gradient: Annotated[Array, "width"]
    hessian: Annotated[Array, "normal"]
    weights: Annotated[Array, "robust"]
    trial: Annotated[Array, "stored"]
    residual: Annotated[Array, "residuals"]
    jacobian: Annotated[Array, "entries"]
    next_constraints: Annotated[Array, "rows"]
    next_jacobian: Annotated[Array, "row_entries"]
    next_gradient: Annotated[Array, "width"]
    next_hessian: Annotated[Array, "normal"]
    squares: Annotated[Array, "robust"]
    next_weights: Annotated[Array, "robust"]
    norms: Annotated[Array, "terms"]
    heights: Annotated[Array, "general"]
    concavity: Annotated[Array, "concave"]
    kkt: Annotated[Array, NUMBERS]
    steepest_jacobian: Annotated[Array, "row_entries"]
    steepest_gradient: Annotated[Array, "width"]
    log: Annotated[Array, "log"]


@compiled
def attempt(problem: Problem, work: Work) -> None:
    """Go on at a stage, to a step that was taken, or refused, or a question to Python."""
    now, terms = work.scalars[0], problem.terms
    if now.moved == 1:
        now.moved, now.cost = 0, now.next_cost
        copy_to(work.trial, work.values)
        copy_to(work.next_constraints, work.constraints)
        copy_to(work.next_jacobian, work.constraint_jacobian)
        copy_to(work.next_gradient, work.gradient)
        copy_to(work.next_hessian, work.hessian)
        copy_to(work.next_weights, work.weights)
    stage = now.stage
    if stage == POSED:
        if not _solve(problem, work):
            now.answer, now.stage = SOLVE, SOLVED
            return
        stage = SOLVED
    if stage == SOLVED:
        if now.stage == SOLVED:
            times(terms, False, work.constraint_jacobian, work.step, work.linear)
        now.corrected, now.length, stage = 0, 1.0, AIMED
        if now.full_steps == 0:
            raise_prices(work.penalties, work.dual)
            if not _descends(problem, work):
                now.answer = REFUSED
                return
    while True:
        if stage == AIMED:
            for k in range(len(work.step)):
                work.taken[k] = work.bent[k] if now.corrected == 1 else now.length * work.step[k]
            if now.assisted == 0:
                _evaluate(problem, work)
            elif now.full_steps == 0:
                now.answer, now.stage = EVALUATE, EVALUATED
                return
            stage = EVALUATED
        if stage == EVALUATED:
            stage = MISSED
            if now.full_steps == 1 or _accepts(terms, work):
                stage = LINEARIZED
                if now.assisted == 1:
                    now.answer, now.stage = LINEARIZE, LINEARIZED
                    return
                linearize(problem, work)
        if stage == LINEARIZED:
            stage = MISSED
            sound = math.isfinite(now.next_cost) and all_finite(work.next_gradient)
            if now.full_steps == 1 or (sound and all_finite(work.next_constraints) and all_finite(work.next_jacobian)):
                _take(problem, work)
                now.answer = TAKEN
                return
        first, now.corrected = now.corrected == 0, 2
        if first and now.correcting == 1 and len(work.bend) and _finite(work):
            for row in range(len(work.bend)):
                work.bend[row] = work.next_constraints[row] - work.constraints[row] - work.linear[row]
            now.answer, now.stage = CORRECT, MISSED
            return
        now.length *= 0.5
        stage = AIMED
        if now.length < SHORTEST:
            now.answer = REFUSED
            return


@compiled
def _solve(problem: Problem, work: Work) -> bool:
    """Answer the subproblem of Gauss-Newton's Hessian on the graph; false where another route has to look at it."""
    now, terms, constraints, linear = work.scalars[0], problem.terms, work.constraints, work.linear
    slope, matrix = np.empty(len(work.step)), work.hessian.copy()
    for k in range(len(slope)):
        slope[k] = work.gradient[problem.free[k]]
        matrix[problem.diagonal[k]] += now.damping / work.columns[k] ** 2
    lower, upper, room = terms.lower - constraints, terms.upper - constraints, 2 * len(constraints)
    copy_to(work.multipliers, work.dual)
    row, sign, limit = np.empty(room, np.int64), np.empty(room), np.empty(room)
    sides = list_sides(lower, upper, row, sign, limit)
    iterations = number(
        problem.links[MINIMIZE],
        (
            terms, problem.system, problem.free, matrix, slope, work.constraint_jacobian, row[:sides], sign[:sides],
            limit[:sides], lower, problem.equality, max(now.accuracy, TIGHTEST), now.patience, work.step, work.dual,
            linear, work.measured,
        ),
    )  # fmt: skip
    # Where the active sides were not found, those of the next subproblem are looked for with less zeal.
    now.iterations, now.patience, now.error = int(abs(iterations)), PATIENCE if work.measured[1] == 0.0 else 1, np.inf
    if not (iterations >= 0.0 and all_finite(work.step) and all_finite(work.dual)):
        return False
    now.error = work.measured[0]
    if now.error > 10.0 * now.accuracy:
        return False
    return now.error <= 0.1 * now.tolerance or not leaves_most(linear, lower, upper, 0.1 * now.tolerance)


@compiled
def raise_prices(penalties: Array, multipliers: Array) -> None:
    """Keep every penalty above its multiplier, and let it come down slowly."""
    for row in range(len(penalties)):
        size = abs(multipliers[row])
        penalties[row] = max(1.1 * size, 0.5 * (penalties[row] + size))


@compiled
def highest_price(penalties: Array, units: Array) -> float:
    """The highest penalty in scaled units, at least one."""
    highest = 1.0
    for row in range(len(penalties)):
        highest = max(highest, penalties[row] / units[row])
    return highest


@compiled
def _outside(value: float, lower: float, upper: float) -> float:
    """Violation of a row; NaN stays."""
    above, below = value - upper, lower - value
    return (0.0 if above <= 0.0 else above) + (0.0 if below <= 0.0 else below)


@compiled
def scaled_violation(constraints: Array, lower: Array, upper: Array, units: Array) -> float:
    """Sum over the rows, each in its unit."""
    total = 0.0
    for row in range(len(constraints)):
        total += units[row] * _outside(constraints[row], lower[row], upper[row])
    return total


@compiled
def _descends(problem: Problem, work: Work) -> bool:
    """Measure the merit and its slope along the step; false where it would rise."""
    now, terms = work.scalars[0], problem.terms
    lower, upper = terms.lower, terms.upper
    slope, here = 0.0, now.cost
    for k in range(len(work.step)):
        slope += work.gradient[problem.free[k]] * work.step[k]
    for row in range(len(work.linear)):
        value, price = work.constraints[row], work.penalties[row]
        before = _outside(value, lower[row], upper[row])
        here += price * before
        slope += price * (_outside(value + work.linear[row], lower[row], upper[row]) - before)
    now.here, now.slope = here, slope
    if now.least_squares == 1:  # what is rounding depends on the cost alone, whose unit is free
        now.slack = ROUNDING * abs(here)
    else:
        # The QP meets its conditions to its own accuracy only; what that costs in merit is noise.
        noise = max(NOISE * highest_price(work.penalties, work.rows), min(now.error, now.accuracy))
        now.slack = ROUNDING * max(1.0, abs(here)) + noise
    return not slope > now.slack


@compiled
def _finite(work: Work) -> bool:
    """Test whether the trial could be evaluated."""
    return math.isfinite(work.scalars[0].trial_cost) and all_finite(work.next_constraints)


@compiled
def _accepts(terms: TermArrays, work: Work) -> bool:
    """Armijo's condition, not too far from the constraints: the merit may be unbounded out there."""
    now = work.scalars[0]
    if not _finite(work):
        return False
    if scaled_violation(work.next_constraints, terms.lower, terms.upper, work.rows) > now.farthest:
        return False
    value = now.trial_cost + scaled_violation(work.next_constraints, terms.lower, terms.upper, work.penalties)
    return bool(value <= now.here + ARMIJO * now.length * now.slope + now.slack)


@compiled
def _evaluate(problem: Problem, work: Work) -> None:
    """Move to the trial and evaluate it."""
    now, links, terms, values, trial = work.scalars[0], problem.links, problem.terms, work.values, work.trial
    copy_to(values, trial)
    work.full[:] = 0.0
    run(links[RETRACT], (problem.retraction, problem.free, work.taken, work.full, values, trial))
    for k in range(len(problem.fixed)):  # retractions wrap and renormalise; a fixed value stays as given
        trial[problem.fixed[k]] = problem.fixed_values[k]
    if now.full_steps == 1:
        return
    now.trial_cost = number(
        links[VALUE],
        (
            terms, trial, work.residual, work.next_constraints, work.squares, work.weights, True,
            problem.scratch,
        ),
    )  # fmt: skip
    if len(work.heights):
        now.trial_cost += number(links[SCALARS], (terms, trial, work.heights, problem.scratch))


@compiled
def linearize(problem: Problem, work: Work) -> None:
    """Linearise where the trial is."""
    now, links, terms = work.scalars[0], problem.links, problem.terms
    work.next_gradient[:] = 0.0
    work.next_hessian[:] = 0.0
    now.next_cost = number(
        links[LINEAR],
        (
            terms, work.trial, work.residual, work.jacobian, work.next_constraints, work.next_jacobian, work.squares,
            work.next_weights, work.norms, work.next_gradient, work.next_hessian, problem.scratch,
            0, 1,
        ),
    )  # fmt: skip
    if len(work.heights):
        work.concavity[:] = 0.0
        added = work.heights, work.next_gradient, work.next_hessian, work.concavity, problem.scratch, True
        now.next_cost += number(links[ADD_SCALARS], (terms, work.trial, *added))


@compiled
def _take(problem: Problem, work: Work) -> None:
    """Multipliers at the end of the step, and what it says about the Hessian of the next one."""
    now, terms = work.scalars[0], problem.terms
    for row in range(len(work.multipliers)):
        found = work.bent_dual[row] if now.corrected == 1 else work.dual[row]
        if now.length < 1.0:
            found = work.multipliers[row] + now.length * (found - work.multipliers[row])
        work.multipliers[row] = found
    curved, change = np.empty(len(work.taken)), np.empty(len(work.gradient))
    multiply(problem.system.kkt, work.hessian, work.taken, curved)
    for k in range(len(change)):
        change[k] = work.next_gradient[k] - work.gradient[k]
    transposed_times(terms, False, work.next_jacobian, work.multipliers, change)
    if now.corrected == 1:
        times(terms, False, work.constraint_jacobian, work.bent, work.linear)
    seen = -now.length * dot(work.linear, work.multipliers)
    for k in range(len(work.taken)):
        seen += work.taken[k] * change[problem.free[k]]
    lacked = missing_curvature(seen, dot(work.taken, curved), work.taken, work.columns)
    now.missing = max(lacked, SECANT_DECAY * now.missing) if now.curved == 0 else 0.0
    now.next_damping = next_damping(now.exact == 1, now.next_damping, now.length)
    now.size = norm(work.taken)


@compiled
def next_damping(exact: bool, damping: float, length: float) -> float:
    """A shortened step means curvature that H does not know: damp, and forget it slowly."""
    if length < 1.0:
        return min(max((EXACT_GROWTH if exact else DAMPING_GROWTH) * damping, FIRST_DAMPING), LARGEST_DAMPING)
    return max((EXACT_DECAY if exact else DAMPING_DECAY) * damping, SMALLEST_DAMPING)


@compiled
def missing_curvature(seen: float, known: float, step: Array, columns: Array) -> float:
    """Curvature of the Lagrangian along a step, by the secant, that the Hessian lacked; zero when it did not matter.

    A Gauss-Newton Hessian leaves out what constraints and residuals bend. Where that is as much as H itself, full steps
    swing to and fro across the answer: the error is multiplied by 1 - (true curvature) / (that of the subproblem).

    Args:
        seen: product of the step and the change of the gradient of the Lagrangian.
        known: product of the step, H without damping, and the step.
        step: (n,) tangent step.
        columns: (n,) factors of scaled units, in which its length is measured.
    """
    squared = 0.0
    for k in range(len(step)):
        squared += (step[k] / columns[k]) ** 2
    if squared < SHORTEST_SECANT**2:
        return 0.0
    missing = (seen - known) / squared
    return missing if missing > SECANT_MATTERS * known / squared else 0.0
