"""The usual iteration of SQP with the engine's own QP in one compiled call: subproblem, merit, line search.

What :mod:`unifg.solvers.sqp` does one after the other from Python, for graphs without anything in Python: the
subproblem in its units, its solution and the test of it, the merit's slope, and the line search - the step in full,
corrected for curved constraints, then halved - with the linearisation where it ends. What decides where an iterate goes
is the same code, called through its addresses. Whatever is not usual (an answer that is not accurate, rows that
contradict each other, a step that leads nowhere) is left to Python, which goes on from the answer at hand.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from unifg.codegen.function_pointers import NOTHING, NUMBER, link_like, number, run
from unifg.codegen.jit import compiled, in_order
from unifg.elimination.symmetric import add_times
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import evaluate, linearize, times, transposed_times
from unifg.problem.linearization import Linearization, all_finite
from unifg.problem.retraction import retract_parts
from unifg.problem.systems import KktArrays
from unifg.problem.table import TermArrays
from unifg.solution.solver import SolveState
from unifg.solvers.augmented_usual import Point, point_at
from unifg.solvers.globalize.line_search import SHORTEST, Taken
from unifg.solvers.globalize.merit import ARMIJO, RowPrices
from unifg.solvers.globalize.norms import largest
from unifg.solvers.quadratic_programs.graph_route import HOPELESS, TIGHTEST, GraphRoute, minimize_quadratic
from unifg.solvers.quadratic_programs.routes import LEFT, USABLE, Subproblems
from unifg.solvers.quadratic_programs.subproblem import FINER, QP, QPAnswer, largest_residual
from unifg.typing import Array, BoolArray, IntArray

NOISE, ROUNDING = 1e-8, 1e-13  # of the merit: per unit of price, and relative

(EVALUATE, LINEARIZE, MINIMIZE, RETRACT, TIMES, TRANSPOSED, LINKS) = range(7)
(COST, ACCURACY, ENOUGH, CERTAIN, FARTHEST, CORRECTING, ERROR, ITERATIONS, LENGTH, TRIAL, NUMBERS) = range(11)
UNTOUCHED, ANSWERED, TAKEN = range(3)
FULL, CORRECTED, HALVED = range(3)


class Problem(NamedTuple):
    """Arrays that no iteration changes.

    Attributes:
        terms: of the program.
        kkt: the system that the engine's QP solves.
        held, equality: (M,) rows that are equalities there, and in the program.
        free: columns that are unknown.
        indptr, indices, columns: pattern of the Hessians of subproblems.
        places: where their entries stand among those of the normal equations.
        entry_rows, entry_columns: row and full column of every entry of the constraint Jacobian.
        retraction: its parts.
        fixed, fixed_values: stored numbers that do not move, and what they are.
        scratch: memory of the loops over terms.
    """

    terms: TermArrays
    kkt: KktArrays
    held: BoolArray
    equality: BoolArray
    free: IntArray
    indptr: IntArray
    indices: IntArray
    columns: IntArray
    places: IntArray
    entry_rows: IntArray
    entry_columns: IntArray
    retraction: IntArray
    fixed: IntArray
    fixed_values: Array
    scratch: Array


class Work(NamedTuple):
    """Arrays that an iteration reads and writes beside its two points.

    Attributes:
        numbers: (NUMBERS,) by the words above.
        hessian, gradient, lower, upper: of the subproblem, in the units of the graph.
        multipliers, prices: (M,) at the start.
        columns, full, rows: units of the unknowns, of the full tangent space and of the rows.
        spread: (width,) the step over the full tangent space.
        norms: (T,) of the terms at the end.
        answer, corrected: (n,) what the subproblem says, and what it says with the limits bent, in its units.
        step: (n,) as taken, in the units of the graph.
        dual, dual_corrected: (M,) multipliers, in the units of the subproblem.
        after, after_corrected: (M,) the same in the units of the graph.
        linear, linear_corrected: (M,) A times the full steps; the first in the units of the graph.
        raised: (M,) prices above these multipliers.
    """

    numbers: Array
    hessian: Array
    gradient: Array
    lower: Array
    upper: Array
    multipliers: Array
    penalties: Array
    columns: Array
    full: Array
    rows: Array
    spread: Array
    norms: Array
    answer: Array
    corrected: Array
    step: Array
    dual: Array
    dual_corrected: Array
    after: Array
    after_corrected: Array
    linear: Array
    linear_corrected: Array
    raised: Array


class UsualSubproblems(Subproblems):
    """Subproblems, and usual iterations on them.

    Attributes:
        known: whether terms and route are such that compiled code can do without Python.
    """

    def __init__(self, program: CompiledProblem, **options: Any) -> None:
        """Make room; options as for :class:`Subproblems`."""
        super().__init__(program, **options)
        self._options = options
        self._curved: UsualSubproblems | None = None
        self._spread = np.zeros(program.columns.width)
        self._norms = np.empty(len(program.arrays.fields))
        self._links = np.zeros(0, dtype=np.int64)
        self._problem: Problem | None = None
        self._answered: QPAnswer | None = None

    @property
    def known(self) -> bool:
        """See the class."""
        program = self.program
        if not isinstance(self.first, GraphRoute) or program.scalar_terms or not program.fully_compiled:
            return False
        return not program.equality.all()  # without inequalities, subproblems are linear systems

    def curved(self) -> UsualSubproblems:
        """The same with the Hessian of the Lagrangian, made when it is first asked for."""
        if self._curved is None:
            self._curved = UsualSubproblems(self.program, **{**self._options, "hessian": "exact"})
        return self._curved

    def take(
        self, start: SolveState, merit: RowPrices, qp: QP, accuracy: float, correcting: bool
    ) -> tuple[QPAnswer, Taken] | None:
        """One iteration: the answer to its subproblem, and the step that was taken; None where it is not usual.

        Args:
            start: the present iterate.
            merit: what the step has to lower; its prices rise.
            qp: the subproblem.
            accuracy: asked of the answer.
            correcting: whether a step that the merit rejects is corrected before it is shortened.
        """
        self._answered = None
        first, program, lin = self.first, self.program, start.lin
        if self._resting or qp.weights is not None or not self.known:
            return None
        assert isinstance(first, GraphRoute)
        n, count = program.size, program.constraints.count
        values = Values(program.columns, lin.values.flat.copy())
        robust = np.empty((2, program.table.weights))
        here, there = point_at(lin), Point(values.flat, *program.buffers.take(), *robust)
        scaling, numbers = self.scaling, np.empty(NUMBERS)
        enough = 10.0 * accuracy if scaling.neutral else FINER * accuracy  # what is less accurate is polished
        numbers[:ERROR] = lin.cost, accuracy, enough, 0.1 * self.tolerance, merit.farthest, correcting
        own: list[Array] = [np.empty(size) for size in (n,) * 3 + (count,) * 7]
        work = Work(
            numbers, qp.hessian, qp.gradient, qp.lower, qp.upper, start.multipliers, merit.penalties, scaling.columns,
            scaling.full, scaling.rows, self._spread, self._norms, *own,
        )  # fmt: skip
        problem = self._problem
        if (
            problem is None
            or problem.terms is not program.arrays
            or problem.equality is not program.equality
            or problem.held is not first.system.held
        ):
            problem = self._problem = self._described(first)
        if not len(self._links):
            self._links = _addresses(problem, here, work)
        how = usual_iteration(self._links, problem, here, there, work)
        if how == UNTOUCHED:
            return None
        iterations = int(numbers[ITERATIONS])
        infeasible = largest(work.dual) > HOPELESS or iterations < 0
        answer = QPAnswer(work.answer, work.dual, first.name, abs(iterations), float(numbers[ERROR]), infeasible)
        if how == ANSWERED:
            self._answered = answer
            return None
        answer.step, answer.multipliers = scaling.columns * work.answer, work.after
        merit.penalties = work.raised
        self._misses, self.elastic_asked, self._first_answered = 0, False, True
        reached = Linearization(
            values, float(numbers[COST]), *there[1:7], program.norms(self._norms), there.weights, squares=there.squares
        )
        dual = work.after_corrected if numbers[TRIAL] == CORRECTED else None
        return answer, Taken(reached, work.step, float(numbers[LENGTH]), dual)

    def by_first(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """The subproblem that :meth:`take` has left, or as :class:`Subproblems`."""
        found, self._answered = self._answered, None
        return super().by_first(qp, multipliers, accuracy) if found is None else found

    def _described(self, first: GraphRoute) -> Problem:
        program, pattern = self.program, self.pattern
        retraction, rows = program.retraction, program.constraints
        places = np.arange(pattern.nnz) if pattern is program.normal else program.objective_places
        return Problem(
            program.arrays, first.system.arrays, first.system.held, program.equality, program.columns.free,
            pattern.indptr, pattern.indices, pattern.columns, places, rows.rows, rows.columns, retraction.parts,
            retraction.fixed, retraction.fixed_values, program.scratch,
        )  # fmt: skip


def _addresses(problem: Problem, here: Point, work: Work) -> IntArray:
    """Compile what an iteration calls, for arrays like these, and say where it stands."""
    terms, rows = problem.terms, here.constraints
    links = np.zeros(LINKS, dtype=np.int64)
    links[EVALUATE] = link_like(
        evaluate, NUMBER, terms, here.values, here.residual, rows, here.squares, here.weights, True, problem.scratch
    )
    links[LINEARIZE] = link_like(
        linearize, NUMBER, terms, here.values, False, here.residual, here.jacobian, rows, here.constraint_jacobian,
        here.squares, here.weights, work.norms, here.gradient, here.hessian, problem.scratch,
    )  # fmt: skip
    links[MINIMIZE] = link_like(
        minimize_quadratic, NUMBER, terms, problem.kkt, problem.free, here.hessian, work.gradient,
        here.constraint_jacobian, problem.free, rows, rows, rows, problem.held, 0.0, work.answer, work.dual,
    )  # fmt: skip
    links[RETRACT] = link_like(
        retract_parts, NOTHING, problem.retraction, problem.free, work.step, work.spread, here.values, here.values
    )
    links[TIMES] = link_like(times, NOTHING, terms, False, here.constraint_jacobian, work.step, rows, None)
    links[TRANSPOSED] = link_like(
        transposed_times, NOTHING, terms, False, here.constraint_jacobian, rows, here.gradient
    )
    return links


@compiled
def usual_iteration(links: IntArray, problem: Problem, here: Point, there: Point, work: Work) -> int:
    """Solve the subproblem and linearise ``there``, at the end of a step that is good enough; how far that went."""
    terms, free, numbers = problem.terms, problem.free, work.numbers
    columns, rows, step = work.columns, work.rows, work.step
    hessian, normal = np.empty(len(work.hessian)), np.zeros(len(here.hessian))
    gradient, jacobian = np.empty(len(work.gradient)), np.empty(len(here.constraint_jacobian))
    lower, upper = work.lower.copy(), work.upper.copy()
    # The subproblem in the units that it is solved in.
    sides = 0
    for row in range(len(lower)):
        if not problem.held[row]:
            sides += int(math.isfinite(lower[row])) + int(math.isfinite(upper[row]))
    if sides == 0:
        return UNTOUCHED
    for k in range(len(hessian)):
        hessian[k] = work.hessian[k] * columns[problem.indices[k]] * columns[problem.columns[k]]
        normal[problem.places[k]] = hessian[k]
    for k in range(len(gradient)):
        gradient[k] = columns[k] * work.gradient[k]
    for k in range(len(jacobian)):
        jacobian[k] = here.constraint_jacobian[k] * rows[problem.entry_rows[k]] * work.full[problem.entry_columns[k]]
    side_row, side_sign, side_limit = np.empty(sides, dtype=np.int64), np.empty(sides), np.empty(sides)
    slope, pull, linear, first = np.empty(len(step)), np.empty(len(there.gradient)), work.linear, work.multipliers
    merit = steep = slack = 0.0
    length, trial = 1.0, FULL
    while True:
        answer, dual, after = work.answer, work.dual, work.after
        if trial == CORRECTED:
            answer, dual, after = work.corrected, work.dual_corrected, work.after_corrected
            first, linear = work.after, work.linear_corrected
        if trial != HALVED:
            at, kept = 0, True
            for above in range(2):
                limits = upper if above else lower
                for row in range(len(dual)):
                    limits[row] *= rows[row]
                    if not problem.held[row] and math.isfinite(limits[row]):
                        side_row[at], side_sign[at], side_limit[at] = row, -1.0 if above else 1.0, limits[row]
                        at += 1
            for row in range(len(dual)):
                kept = kept and (lower[row] == upper[row]) == problem.held[row]
                dual[row] = first[row] / rows[row] if problem.held[row] else 0.0
            if at < sides or not kept:  # rounding or overflow has made other limits of them
                return UNTOUCHED if trial == FULL else ANSWERED
            for k in range(len(answer)):
                answer[k] = slope[k] = 0.0
            iterations = number(
                links[MINIMIZE],
                (
                    terms, problem.kkt, free, normal, gradient, jacobian, side_row, side_sign, side_limit, lower,
                    problem.held, max(numbers[ACCURACY], TIGHTEST), answer, dual,
                ),
            )  # fmt: skip
            error = np.inf
            if all_finite(answer) and all_finite(dual):
                for k in range(len(pull)):
                    pull[k] = 0.0
                add_times(problem.indptr, problem.indices, hessian, answer, slope)
                run(links[TRANSPOSED], (terms, False, jacobian, dual, pull))
                for k in range(len(slope)):
                    slope[k] += gradient[k]
                    slope[k] += pull[free[k]]
                run(links[TIMES], (terms, False, jacobian, answer, linear, None))
                error = largest_residual(slope, linear, lower, upper, dual, problem.equality)
            for k in range(len(answer)):
                step[k] = columns[k] * answer[k]
            for row in range(len(dual)):
                after[row] = rows[row] * dual[row]
        if trial == FULL:
            numbers[ITERATIONS], numbers[ERROR] = iterations, error
            if not error <= numbers[ENOUGH]:
                return ANSWERED
            if error > numbers[CERTAIN]:
                left = missed = 0.0
                for row in range(len(dual)):
                    left = max(left, linear[row] - upper[row], lower[row] - linear[row])
                    missed = max(missed, -upper[row], lower[row])
                if left > max(LEFT * missed, numbers[CERTAIN]):
                    return ANSWERED
            # The merit: whether the step is one of descent.
            descent = priced = change = 0.0
            price = 1.0
            for k in range(len(step)):
                descent += work.gradient[k] * step[k]
            for row in range(len(dual)):
                size = abs(after[row])
                raised = work.raised[row] = max(1.1 * size, 0.5 * (work.penalties[row] + size))
                price = max(price, raised / rows[row])
                linear[row] /= rows[row]
                value, low, high = here.constraints[row], terms.lower[row], terms.upper[row]
                outside = _outside(value, low, high)
                priced += raised * outside
                change += raised * (_outside(value + linear[row], low, high) - outside)
            merit, steep = numbers[COST] + priced, descent + change
            slack = ROUNDING * max(1.0, abs(merit)) + max(NOISE * price, min(error, numbers[ACCURACY]))
            if not steep <= slack:
                return ANSWERED
        elif trial == HALVED:
            length *= 0.5
            if length < SHORTEST:
                return ANSWERED
            for k in range(len(step)):
                step[k] = length * columns[k] * answer[k]
        good = trial != CORRECTED or error <= USABLE
        if good:
            run(links[RETRACT], (problem.retraction, free, step, work.spread, here.values, there.values))
            for k in range(len(problem.fixed)):
                there.values[problem.fixed[k]] = problem.fixed_values[k]
            for k in range(len(there.gradient)):
                there.gradient[k] = 0.0
            for k in range(len(there.hessian)):
                there.hessian[k] = 0.0
            cost = number(
                links[LINEARIZE],
                (
                    terms, there.values, False, there.residual, there.jacobian, there.constraints,
                    there.constraint_jacobian, there.squares, there.weights, work.norms, there.gradient, there.hessian,
                    problem.scratch,
                ),
            )  # fmt: skip
            good = math.isfinite(cost) and all_finite(there.gradient) and all_finite(there.constraints)
            good = good and all_finite(there.constraint_jacobian)
            if trial == FULL and not good:
                return ANSWERED
            distance = priced = 0.0
            for row in range(len(dual)):
                outside = _outside(there.constraints[row], terms.lower[row], terms.upper[row])
                distance += rows[row] * outside
                priced += work.raised[row] * outside
            good = good and not distance > numbers[FARTHEST]
            if good and cost + priced <= merit + ARMIJO * length * steep + slack:
                numbers[COST], numbers[LENGTH], numbers[TRIAL] = cost, length, trial
                return TAKEN
        if trial == FULL and numbers[CORRECTING] > 0.0:
            trial = CORRECTED
            number(
                links[EVALUATE],
                (
                    terms, there.values, there.residual, there.constraints, there.squares, here.weights, True,
                    problem.scratch,
                ),
            )  # fmt: skip
            _bend(work.lower, there.constraints, here.constraints, linear, lower)
            _bend(work.upper, there.constraints, here.constraints, linear, upper)
        else:
            trial = HALVED


@in_order
def _bend(limits: Array, there: Array, here: Array, linear: Array, out: Array) -> None:
    """Limits of a subproblem for constraints as they were found after a step, by what they bend."""
    for row in range(len(out)):
        out[row] = limits[row] - (there[row] - here[row] - linear[row])


@compiled
def _outside(value: float, lower: float, upper: float) -> float:
    """Violation of a row."""
    return max(value - upper, lower - value, 0.0)
