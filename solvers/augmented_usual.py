"""The usual iteration of the augmented Lagrangian in one compiled call: the first trial is taken as it is.

What :mod:`unifg.solvers.augmented_step` does one after the other from Python, for graphs without anything in Python:
second derivatives, model, trial, its linearisation, the test of it, and the multipliers to go on with. The functions
are the same, called through their addresses. Whatever is not usual (a model that is not convex, a trial that has to be
corrected or rejected) is left to Python, which begins the iteration anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from unifg.codegen.function_pointers import NOTHING, NUMBER, link_like, number, run
from unifg.codegen.jit import compiled
from unifg.elimination.plan import Plan
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import linearize, times
from unifg.problem.hessian import add_curvature, add_losses
from unifg.problem.linearization import Linearization, all_finite
from unifg.problem.retraction import retract_parts
from unifg.problem.table import TermArrays
from unifg.solvers.augmented_objective import Primal, barrier, slope_of, update
from unifg.solvers.augmented_step import ROUNDING, WELL, minimize
from unifg.solvers.globalize.damping import SUFFICIENT, Damping, gain
from unifg.typing import Array, BoolArray, IntArray

(BARRIER, CURVE, WEIGH, LINEARIZE, MINIMIZE, RETRACT, SLOPE, TIMES, UPDATE, LINKS) = range(10)
(COST, DAMPING, GOAL, UNIT, PREDICTED, ACTUAL, SLACK, STEEP, NUMBERS) = range(9)
UNUSUAL, EXPECTED, FIRST_ORDER = range(3)


class Problem(NamedTuple):
    """Arrays that no iteration changes.

    Attributes:
        terms: of the program.
        plan: elimination of the normal equations.
        free: columns that are unknown.
        indptr, indices, equality: pattern of the normal equations, and which rows are equalities.
        retraction: its parts.
        fixed, fixed_values: stored numbers that do not move, and what they are.
        scratch, none: memory of the loops over terms, and an empty array.
    """

    terms: TermArrays
    plan: Plan
    free: IntArray
    indptr: IntArray
    indices: IntArray
    equality: BoolArray
    retraction: IntArray
    fixed: IntArray
    fixed_values: Array
    scratch: Array
    none: Array


class Point(NamedTuple):
    """Arrays of a linearisation."""

    values: Array
    residual: Array
    jacobian: Array
    constraints: Array
    constraint_jacobian: Array
    gradient: Array
    hessian: Array
    squares: Array
    weights: Array


class Work(NamedTuple):
    """Arrays that an iteration reads and writes beside its two points.

    Attributes:
        numbers: (NUMBERS,) by the words above.
        multipliers, penalty: (M,) of the augmented objective.
        bent_by: (M,) multipliers of the second derivatives; empty for Gauss-Newton's Hessian.
        bend: (nnz,) second derivatives.
        step: (n,).
        spread: (width,) the same over the full tangent space.
        moved: (M,) A times the step.
        lower, upper: (M,) limits from where the constraints are.
        norms: (T,) of the terms at the end.
        expected, plus: (M,) multipliers by the linear model, and by the constraints at the end.
    """

    numbers: Array
    multipliers: Array
    penalty: Array
    bent_by: Array
    bend: Array
    step: Array
    spread: Array
    moved: Array
    lower: Array
    upper: Array
    norms: Array
    expected: Array
    plus: Array


class Taken(NamedTuple):
    """An iteration.

    Attributes:
        lin: where it led to.
        step: (n,) to there, good until the next one.
        expected: (M,) multipliers that the linear model predicts.
        after: (M,) those that balance the gradient best.
        slope: largest entry of the gradient of the Lagrangian with these.
    """

    lin: Linearization
    step: Array
    expected: Array
    after: Array
    slope: float


class UsualPrimal(Primal):
    """The augmented objective, with usual iterations on it.

    Attributes:
        fast: whether compiled code can do without Python.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Make room."""
        super().__init__(program)
        self._bend = np.empty(program.normal.nnz)
        self._step, self._spread = np.empty(program.size), np.zeros(program.columns.width)
        self._rows = [np.empty(program.constraints.count) for _ in range(3)]
        self._norms, self._none = np.empty(len(program.arrays.fields)), np.zeros(0)
        self._links = np.zeros(0, dtype=np.int64)
        self._problem: Problem | None = None

    @property
    def fast(self) -> bool:
        """See the class: a term that was traced may be given up between two solves."""
        return self.program.fully_compiled

    def take(
        self, lin: Linearization, multipliers: Array, bent_by: Array, penalty: Array, damping: Damping, goal: float
    ) -> Taken | None:
        """One iteration; None, and nothing changed, where it is not a usual one.

        Args:
            lin: where.
            multipliers: (M,) of the augmented objective.
            bent_by: (M,) multipliers of the second derivatives; empty for Gauss-Newton's Hessian.
            penalty: (M,) rho of every row.
            damping: what it begins with, and what it learns.
            goal: of the slope; below it there is no other estimate of the multipliers.
        """
        if not self.fast or 4.0 * damping.share < 1.0:
            return None
        program = self.program
        values = Values(program.columns, lin.values.flat.copy())
        robust = np.empty((2, program.table.weights))
        here, there = point_at(lin), Point(values.flat, *program.buffers.take(), *robust)
        numbers = np.empty(NUMBERS)
        unit = 0.0 if program.least_squares else 1.0
        numbers[COST], numbers[DAMPING], numbers[GOAL], numbers[UNIT] = lin.cost, damping.value, goal, unit
        expected, plus = np.empty(len(penalty)), np.empty(len(penalty))
        moved, lower, upper = self._rows
        work = Work(
            numbers, multipliers, penalty, bent_by, self._bend, self._step, self._spread, moved, lower, upper,
            self._norms, expected, plus,
        )  # fmt: skip
        problem = self._problem
        if problem is None or problem.equality is not program.equality:
            retraction, normal = program.retraction, program.normal
            problem = self._problem = Problem(
                program.arrays, self.solver.plan, program.columns.free, normal.indptr, normal.indices,
                program.equality, retraction.parts, retraction.fixed, retraction.fixed_values, program.scratch,
                self._none,
            )  # fmt: skip
        if not len(self._links):
            self._links = _addresses(problem, here, work)
        how = usual_iteration(self._links, problem, here, there, work)
        if how == UNUSUAL:
            return None
        _, damped, _, _, predicted, actual, slack, slope = numbers.tolist()
        gained = gain(actual, predicted, slack)
        assert gained is not None
        self.damping = damped
        self.solver.adopt(True)
        damping.share = 1.0
        damping.accept(min(gained, 1.0))
        damping.base = lin.constraints
        norms = program.norms(self._norms)
        reached = Linearization(values, numbers[COST], *there[1:7], norms, there.weights, squares=there.squares)
        return Taken(reached, self._step, expected, expected if how == EXPECTED else plus, slope)


def point_at(lin: Linearization) -> Point:
    """The arrays of a linearisation."""
    return Point(
        lin.values.flat, lin.residual, lin.jacobian, lin.constraints, lin.constraint_jacobian, lin.gradient,
        lin.hessian, lin.squares, lin.weights,
    )  # fmt: skip


def _addresses(problem: Problem, here: Point, work: Work) -> IntArray:
    """Compile what an iteration calls, for arrays like these, and say where it stands."""
    terms, rows = problem.terms, here.constraints
    links = np.zeros(LINKS, dtype=np.int64)
    links[BARRIER] = link_like(barrier, NUMBER, rows, rows, rows, rows, rows)
    links[CURVE] = link_like(add_curvature, NOTHING, terms, here.values, here.residual, here.weights, rows, work.bend)
    links[WEIGH] = link_like(
        add_losses, NOTHING, terms, here.residual, here.jacobian, here.squares, here.weights, work.bend
    )
    links[LINEARIZE] = link_like(
        linearize, NUMBER, terms, here.values, False, here.residual, here.jacobian, rows, here.constraint_jacobian,
        here.squares, here.weights, work.norms, here.gradient, here.hessian, problem.scratch,
    )  # fmt: skip
    links[MINIMIZE] = link_like(
        minimize, NUMBER, terms, problem.plan, problem.free, problem.indptr, problem.indices, problem.equality,
        here.residual, here.jacobian, rows, here.constraint_jacobian, here.hessian, work.bend, rows, rows, 0.0,
        work.step,
    )  # fmt: skip
    links[RETRACT] = link_like(
        retract_parts, NOTHING, problem.retraction, problem.free, work.step, work.spread, here.values, here.values
    )
    links[SLOPE] = link_like(slope_of, NUMBER, terms, problem.free, here.gradient, here.constraint_jacobian, rows)
    links[TIMES] = link_like(times, NOTHING, terms, False, here.constraint_jacobian, work.step, rows, None)
    links[UPDATE] = link_like(update, NOTHING, rows, rows, rows, rows, rows, rows)
    return links


@compiled
def usual_iteration(links: IntArray, problem: Problem, here: Point, there: Point, work: Work) -> int:
    """Linearise ``there`` after a usual step; which multipliers are the better ones, or that it is not usual."""
    terms, numbers, step = problem.terms, work.numbers, work.step
    multipliers, penalty, bend = work.multipliers, work.penalty, work.bend
    merit = numbers[COST] + number(links[BARRIER], (here.constraints, terms.lower, terms.upper, multipliers, penalty))
    slack = ROUNDING * max(numbers[UNIT], abs(merit))
    if len(work.bent_by):
        for k in range(len(bend)):
            bend[k] = here.hessian[k]
        run(links[CURVE], (terms, here.values, here.residual, here.weights, work.bent_by, bend))
        if len(here.weights):
            run(links[WEIGH], (terms, here.residual, here.jacobian, here.squares, here.weights, bend))
    total, curved = 0.0, False
    for k in range(len(bend) if len(work.bent_by) else 0):
        bend[k] -= here.hessian[k]
        curved = curved or bend[k] != 0.0
        total += bend[k]
    if not (curved and math.isfinite(total)):
        bend = problem.none
    for k in range(len(step)):
        step[k] = 0.0
    predicted = number(
        links[MINIMIZE],
        (
            terms, problem.plan, problem.free, problem.indptr, problem.indices, problem.equality, here.residual,
            here.jacobian, here.constraints, here.constraint_jacobian, here.hessian, bend, multipliers, penalty,
            numbers[DAMPING], step,
        ),
    )  # fmt: skip
    if math.isnan(predicted):
        return UNUSUAL
    run(links[RETRACT], (problem.retraction, problem.free, step, work.spread, here.values, there.values))
    for k in range(len(problem.fixed)):
        there.values[problem.fixed[k]] = problem.fixed_values[k]
    for k in range(len(there.gradient)):
        there.gradient[k] = 0.0
    for k in range(len(there.hessian)):
        there.hessian[k] = 0.0
    cost = number(
        links[LINEARIZE],
        (
            terms, there.values, False, there.residual, there.jacobian, there.constraints, there.constraint_jacobian,
            there.squares, there.weights, work.norms, there.gradient, there.hessian, problem.scratch,
        ),
    )  # fmt: skip
    finite = math.isfinite(cost) and all_finite(there.gradient) and all_finite(there.constraints)
    if not (finite and all_finite(there.constraint_jacobian)):
        return UNUSUAL
    reached = cost + number(links[BARRIER], (there.constraints, terms.lower, terms.upper, multipliers, penalty))
    actual = merit - reached
    if not actual >= SUFFICIENT * predicted - slack or (len(bend) and actual < WELL * predicted - slack):
        return UNUSUAL
    run(links[TIMES], (terms, False, here.constraint_jacobian, step, work.moved, None))
    for row in range(len(penalty)):
        work.lower[row] = terms.lower[row] - here.constraints[row]
        work.upper[row] = terms.upper[row] - here.constraints[row]
    run(links[UPDATE], (work.moved, work.lower, work.upper, multipliers, penalty, work.expected))
    slope = number(links[SLOPE], (terms, problem.free, there.gradient, there.constraint_jacobian, work.expected))
    how = EXPECTED
    if not slope <= numbers[GOAL]:
        run(links[UPDATE], (there.constraints, terms.lower, terms.upper, multipliers, penalty, work.plus))
        balance = number(links[SLOPE], (terms, problem.free, there.gradient, there.constraint_jacobian, work.plus))
        if not slope < balance:
            how, slope = FIRST_ORDER, balance
    numbers[COST], numbers[PREDICTED], numbers[ACTUAL], numbers[SLACK] = cost, predicted, actual, slack
    numbers[STEEP] = slope
    return how
