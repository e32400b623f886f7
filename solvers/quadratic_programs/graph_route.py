"""Quadratic subproblems by elimination on the graph: one linear system, or an interior point over such systems.

Without inequalities the subproblem is the KKT system itself. With them, every finite limit is a side v >= 0 with a
multiplier y. Between subproblems the set of active sides changes little, and is looked for first, from the last
multipliers (a primal-dual active set method, Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002)): where it is that
of the last subproblem one factorisation does. Where the set does not settle, Mehrotra's predictor-corrector method
(SIAM J. Optim. 2 (1992)) solves two systems with one factorisation per iteration, for slacks s.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.elimination.fronts import factor
from unifg.elimination.substitution import solve
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import times, transposed_times
from unifg.problem.systems import KktArrays, fill, fill_stacked, stacked
from unifg.problem.table import TermArrays
from unifg.solvers.globalize.norms import largest
from unifg.solvers.quadratic_programs.subproblem import FINER, QP, QPAnswer, qp_error
from unifg.typing import Array, BoolArray, IntArray

ITERATIONS = 60
TIGHTEST = 1e-12  # accuracy
CHANGES = 12  # of the set of active sides, before an interior point takes over
PATIENCE = 2  # times that they may be no fewer than before, after which it does
CORRECTIONS = 4  # of one set
HEAVY = 1e5  # weight of the squares of held sides, relative to the largest entry of the Hessian
BOUNDARY = 0.995  # fraction of the way to the boundary
SHIFT = 1e-10  # keeps the KKT matrix quasi-definite, relative to nothing: rows are in the problem's own units
RESIDUAL = 1e-8  # relative, of a linear system without a solution: the rows contradict each other
FARTHEST = 1e3  # sum of the numbers of a step beyond which none is looked for, relative to that of the present one
CONTRADICTED = -1.0  # in the place of an error
HOPELESS = 1e9  # multipliers beyond this mean that the rows contradict each other


class Stacked(NamedTuple):
    """A KKT matrix whose entries come as those of the Hessian, then those of held rows, without being filled in.

    Attributes:
        kkt: with the plan for them.
        doubles: as of :func:`unifg.problem.systems.stacked`.
    """

    kkt: KktArrays
    doubles: IntArray

    @classmethod
    def of(cls, arrays: KktArrays) -> Stacked:
        """Find the plan."""
        plan, doubles = stacked(arrays)
        return cls(arrays._replace(plan=plan), doubles)


class GraphRoute:
    """The engine as a QP solver.

    Attributes:
        name: "graph".
        system: the KKT matrix with the equalities of the last subproblem.
    """

    name = "graph"

    def __init__(self, program: CompiledProblem) -> None:
        """Analyse the KKT matrix."""
        self.program = program
        self.system = program.systems.kkt(program.equality)
        self._stacked: Stacked | None = None

    def begin(self) -> None:
        """Nothing is left of a solve."""

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve to ``accuracy`` from the step zero and ``multipliers``, and measure."""
        program = self.program
        sides, hessian, stacked = self._load(qp)
        step, dual = np.zeros(program.size), multipliers.copy()
        if not len(sides[0]):
            error = self._linear(qp, hessian, dual, step)
            return QPAnswer(step, dual, self.name, 1, qp_error(qp, step, dual), not error <= RESIDUAL)
        linear, measured = np.empty(program.constraints.count), np.empty(2)
        iterations = int(
            minimize_quadratic(
                program.arrays, stacked, program.columns.free, hessian, qp.gradient, qp.jacobian, *sides, qp.lower,
                self.system.held, max(accuracy, TIGHTEST), PATIENCE, step, dual, linear, measured,
            )
        )  # fmt: skip
        error = qp_error(qp, step, dual) if iterations >= 0 else np.inf
        return QPAnswer(step, dual, self.name, abs(iterations), error, hopeless(measured, dual))

    def complete(self, qp: QP, step: Array, dual: Array, accuracy: float) -> float:
        """Bring step and multipliers, whose active sides are about right, to ``accuracy``; returns the error."""
        program, measured = self.program, np.full(2, np.inf)
        sides, hessian, stacked = self._load(qp)
        hold_active(
            program.arrays, stacked, program.columns.free, hessian, qp.gradient, qp.jacobian, *sides, qp.lower,
            max(accuracy, TIGHTEST), PATIENCE, step, dual, qp.linear(step), measured,
        )  # fmt: skip
        return qp_error(qp, step, dual) if measured[0] < np.inf else np.inf

    def _load(self, qp: QP) -> tuple[tuple[IntArray, Array, Array], Array, Stacked]:
        """Row, sign and limit of the sides, H in the pattern of ``normal``, and the matrix with the equalities."""
        program, equality = self.program, qp.lower == qp.upper
        if self._stacked is None or not np.array_equal(equality, self.system.held):
            self.system = program.systems.kkt(equality)
            self._stacked = Stacked.of(self.system.arrays)
        room = 2 * len(equality)
        row, sign, limit = np.empty(room, np.int64), np.empty(room), np.empty(room)
        count = list_sides(qp.lower, qp.upper, row, sign, limit)
        sides = row[:count], sign[:count], limit[:count]
        hessian = qp.hessian
        if qp.pattern is not program.normal:
            hessian = np.zeros(program.normal.nnz)
            hessian[program.objective_places] = qp.hessian
        return sides, hessian, self._stacked

    def _linear(self, qp: QP, hessian: Array, dual: Array, step: Array) -> float:
        """Solve the KKT system: sets ``step``, moves ``dual``, returns the relative residual."""
        program, arrays, n = self.program, self.system.arrays, self.program.size
        data, right = np.zeros(self.system.pattern.nnz), np.empty(n + len(arrays.rows))
        fill(arrays, hessian, qp.jacobian, data)
        if not self.system.saddle.factor(data):
            return np.inf
        pull = program.constraints.transposed_times(qp.jacobian, dual)[program.columns.free]
        right[:n], right[n:] = -(qp.gradient + pull), qp.lower[arrays.rows]
        found, error = self.system.saddle.solve(right)
        step[:] = found[:n]
        dual[arrays.rows] += found[n:]
        return error


@compiled
def list_sides(lower: Array, upper: Array, row: IntArray, sign: Array, limit: Array) -> int:
    """Write row, sign and limit of every finite limit of an inequality; returns how many there are."""
    count = 0
    for k in range(len(lower)):
        if lower[k] == upper[k]:
            continue
        for lowest in (True, False):
            border = lower[k] if lowest else upper[k]
            if math.isfinite(border):
                row[count], sign[count], limit[count] = k, 1.0 if lowest else -1.0, border
                count += 1
    return count


def hopeless(measured: Array, dual: Array) -> bool:
    """Test whether :func:`minimize_quadratic` has found that the rows contradict each other."""
    return bool(measured[0] == CONTRADICTED or largest(dual) > HOPELESS)


class Polish:
    """The last digits of an answer: one linear system of the limits found active.

    Where units are far apart the test of the graph asks for more digits than interior points and first-order methods
    give. The KKT system of the active rows, equilibrated and refined (:mod:`unifg.elimination.saddle`), gives what
    double precision holds.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Remember the program; systems are analysed when first needed."""
        self._program = program
        self._route: GraphRoute | None = None

    def __call__(self, qp: QP, answer: QPAnswer) -> QPAnswer:
        """The better of an answer and what its active rows make of it."""
        dual = answer.multipliers
        limit = np.where(dual > 0.0, qp.upper, qp.lower)
        distance = np.where(np.isfinite(limit), np.abs(qp.linear(answer.step) - limit), np.inf)
        active = (qp.lower == qp.upper) | (np.abs(dual) > distance)
        held = replace(qp, lower=np.where(active, limit, -np.inf), upper=np.where(active, limit, np.inf), weights=None)
        if self._route is None:
            self._route = GraphRoute(self._program)
        found = self._route.solve(held, dual, 0.0)
        error = qp_error(qp, found.step, found.multipliers)
        return (
            replace(answer, step=found.step, multipliers=found.multipliers, error=error)
            if error < answer.error
            else answer
        )


@compiled
def hold_active(
    terms: TermArrays,
    system: Stacked,
    free: IntArray,
    hessian: Array,
    gradient: Array,
    jacobian: Array,
    side_row: IntArray,
    side_sign: Array,
    side_limit: Array,
    lower: Array,
    accuracy: float,
    patience: int,
    step: Array,
    dual: Array,
    linear: Array,
    measured: Array,
) -> float:
    """Find the active sides from `step` and `dual`; returns the systems factorised, negative when none of them did.

    Sides that are held come in as squares v^2 W / 2, and y moves by -W v until v vanishes: every matrix has the pattern
    of the equalities alone. What y < 0 pushes inwards is let go, what v < 0 violates is held, and all is solved anew.
    Sets ``step``, ``dual``, A times the step, which is given in ``linear``, and ``measured``, the largest of
    stationarity, infeasibility and complementarity.
    """
    kkt = system.kkt
    n, equalities, sides, count = kkt.size[0], kkt.size[1], len(side_row), len(lower)
    row_terms, weights, move = np.zeros(count), np.zeros(count), np.zeros(count)
    full, data = np.zeros(len(terms.unknown)), np.empty(len(kkt.plan.slots))
    right, found, shift = np.zeros(n + equalities), np.zeros(n + equalities), np.zeros(n + equalities)
    shift[:n], shift[n:] = SHIFT, -SHIFT
    y, held, heavy = np.zeros(sides), np.zeros(sides, np.bool_), 0.0
    for k in range(len(hessian)):
        heavy = max(heavy, abs(hessian[k]))
    heavy, fine = HEAVY * max(heavy, 1e-3), max(FINER * accuracy, TIGHTEST)
    for k in range(sides):
        y[k] = max(0.0, -side_sign[k] * dual[side_row[k]])
        held[k] = y[k] > side_sign[k] * (linear[side_row[k]] - side_limit[k])
        if not held[k]:
            y[k] = 0.0
    before = sides + 1
    for change in range(CHANGES):
        weights[:] = 0.0
        for k in range(sides):
            if held[k]:
                weights[side_row[k]] = heavy
        _load(terms, system, hessian, jacobian, weights, data)
        if not factor(kkt.plan, data, shift):
            return -change - 1.0
        changes = 0
        for correction in range(CORRECTIONS + 1):
            row_terms[:] = 0.0
            for k in range(equalities):
                row_terms[kkt.rows[k]] = dual[kkt.rows[k]]
            worst = 0.0
            for k in range(sides):
                if held[k]:
                    row_terms[side_row[k]] = -side_sign[k] * y[k]
                    worst = max(worst, abs(linear[side_row[k]] - side_limit[k]) * max(1.0, y[k]))
            _residual(terms, kkt, free, hessian, gradient, jacobian, lower, linear, row_terms, step, full, right)
            for k in range(n + equalities):
                worst = max(worst, abs(right[k]))
            last = correction == CORRECTIONS
            if correction > 0 and worst <= (accuracy if last else fine):
                for k in range(sides):
                    dual[side_row[k]] = 0.0
                for k in range(sides):
                    dual[side_row[k]] -= side_sign[k] * y[k]
                measured[0] = max(worst, fine)
                return change + 1.0
            if last or not worst < HOPELESS:
                return -change - 1.0
            row_terms[:] = 0.0
            for k in range(sides):
                if held[k]:
                    row_terms[side_row[k]] = heavy * (linear[side_row[k]] - side_limit[k])
            full[:] = 0.0
            transposed_times(terms, False, jacobian, row_terms, full)
            for k in range(n):
                right[k] -= full[free[k]]
            solve(kkt.plan, right, found)
            times(terms, False, jacobian, found, move)
            for k in range(n):
                step[k] += found[k]
            for k in range(equalities):
                dual[kkt.rows[k]] += found[n + k]
            for row in range(count):
                linear[row] += move[row]
            for k in range(sides):
                value = side_sign[k] * (linear[side_row[k]] - side_limit[k])
                if not held[k]:
                    if value < -fine:
                        held[k] = True
                        changes += 1
                else:
                    y[k] -= heavy * value
                    if y[k] < 0.0:
                        held[k], y[k] = False, 0.0
                        changes += 1
            if changes > 0:
                break
        patience -= 1 if changes >= before else 0
        if patience == 0:
            return -change - 1.0
        before = changes
    return -float(CHANGES)


@compiled
def minimize_quadratic(
    terms: TermArrays,
    system: Stacked,
    free: IntArray,
    hessian: Array,
    gradient: Array,
    jacobian: Array,
    side_row: IntArray,
    side_sign: Array,
    side_limit: Array,
    lower: Array,
    equality: BoolArray,
    accuracy: float,
    patience: int,
    step: Array,
    dual: Array,
    linear: Array,
    measured: Array,
) -> float:
    """Active sets, then Mehrotra's method, each from step zero and `dual`.

    Returns:
        The systems factorised, negative where one was singular or the rows contradict each other. ``measured`` is the
        error of the answer, with A times the step in ``linear``; infinite where the iterations did not suffice, and
        :data:`CONTRADICTED` where there can be none. Behind it stands one where the active sides did not settle.
    """
    kkt, begun, measured[0], measured[1] = system.kkt, dual.copy(), np.inf, 0.0
    step[:] = 0.0
    linear[:] = 0.0
    held = hold_active(
        terms, system, free, hessian, gradient, jacobian, side_row, side_sign, side_limit, lower, accuracy,
        patience, step, dual, linear, measured,
    )  # fmt: skip
    if held > 0.0:
        return held
    copy_to(begun, dual)
    step[:] = 0.0
    measured[1] = 1.0
    n, equalities, sides, count = kkt.size[0], kkt.size[1], len(side_row), len(lower)
    row_terms, weights, move = np.zeros(count), np.zeros(count), np.zeros(count)
    full, data = np.zeros(len(terms.unknown)), np.empty(len(kkt.plan.slots))
    right, found, shift = np.zeros(n + equalities), np.zeros(n + equalities), np.zeros(n + equalities)
    shift[:n], shift[n:] = SHIFT, -SHIFT
    s, y, ds, dy, target = np.ones(sides), np.ones(sides), np.zeros(sides), np.zeros(sides), np.zeros(sides)
    for k in range(sides):
        s[k] = max(1.0, -side_sign[k] * side_limit[k])
    for row in range(count):
        if not equality[row]:
            dual[row] = 0.0
    for iteration in range(ITERATIONS):
        times(terms, False, jacobian, step, linear)
        row_terms[:] = 0.0
        for row in range(count):
            if equality[row]:
                row_terms[row] = dual[row]
        gap = worst = 0.0
        for k in range(sides):
            row_terms[side_row[k]] -= side_sign[k] * y[k]
            value = side_sign[k] * (linear[side_row[k]] - side_limit[k])
            worst = max(worst, abs(value - s[k]), s[k] * y[k])
            gap += s[k] * y[k]
        mu = gap / sides
        _residual(terms, kkt, free, hessian, gradient, jacobian, lower, linear, row_terms, step, full, right)
        for k in range(n + equalities):
            worst = max(worst, abs(right[k]))
        if worst <= accuracy and iteration > 0:
            measured[0] = worst
            for k in range(sides):
                measured[0] = max(measured[0], y[k] * abs(linear[side_row[k]] - side_limit[k]))
            break
        if _contradict(kkt, free, side_sign, side_limit, lower, y, dual, full, step):
            measured[0] = CONTRADICTED
            return held - iteration - 1.0
        weights[:] = 0.0
        for k in range(sides):
            weights[side_row[k]] += y[k] / s[k]
        _load(terms, system, hessian, jacobian, weights, data)
        if not factor(kkt.plan, data, shift):
            return held - iteration - 1.0
        # Predictor: aim at complementarity zero; corrector: at what the predictor suggests is within reach.
        centre = 0.0
        for corrector in range(2):
            row_terms[:] = 0.0
            for k in range(sides):
                target[k] = s[k] * y[k] - centre + (ds[k] * dy[k] if corrector == 1 else 0.0)
                value = side_sign[k] * (linear[side_row[k]] - side_limit[k])
                row_terms[side_row[k]] += side_sign[k] * (target[k] - y[k] * (s[k] - value)) / s[k]
            full[:] = 0.0
            transposed_times(terms, False, jacobian, row_terms, full)
            for k in range(n):
                found[k] = right[k] - full[free[k]]
            for k in range(equalities):
                found[n + k] = right[n + k]
            solve(kkt.plan, found.copy(), found)
            times(terms, False, jacobian, found, move)
            primal = longest = 1.0
            for k in range(sides):
                value = side_sign[k] * (linear[side_row[k]] - side_limit[k])
                ds[k] = value - s[k] + side_sign[k] * move[side_row[k]]
                dy[k] = -(target[k] + y[k] * ds[k]) / s[k]
                if ds[k] < 0.0:
                    primal = min(primal, -s[k] / ds[k])
                if dy[k] < 0.0:
                    longest = min(longest, -y[k] / dy[k])
            if corrector == 0:
                reached = 0.0
                for k in range(sides):
                    reached += (s[k] + primal * ds[k]) * (y[k] + longest * dy[k])
                centre = mu * (reached / max(gap, 1e-300)) ** 3
        length = min(1.0, BOUNDARY * min(primal, longest))
        largest = 0.0
        for k in range(n):
            step[k] += length * found[k]
            largest = max(largest, abs(found[k]))
        if not math.isfinite(largest):
            return held - iteration - 1.0
        for k in range(equalities):
            dual[kkt.rows[k]] += length * found[n + k]
        for k in range(sides):
            s[k] += length * ds[k]
            y[k] += length * dy[k]
    for k in range(sides):
        dual[side_row[k]] -= side_sign[k] * y[k]
    return float(iteration) - held


@compiled
def _load(terms: TermArrays, system: Stacked, hessian: Array, jacobian: Array, weights: Array, data: Array) -> None:
    """Write the entries of the KKT matrix with H + A' diag(weights) A."""
    for k in range(len(hessian)):
        data[k] = hessian[k]
    fill_stacked(terms, system.kkt.entries, system.doubles, jacobian, weights, len(hessian), True, data)


@compiled
def _contradict(
    kkt: KktArrays,
    free: IntArray,
    side_sign: Array,
    side_limit: Array,
    lower: Array,
    y: Array,
    dual: Array,
    full: Array,
    step: Array,
) -> bool:
    """Test whether multipliers prove that no step within reach meets the rows (Farkas' lemma).

    Summed with them, the rows say p'd >= b for p = ``full`` over the unknowns, minus, and for a sum b of limits: no d
    whose absolute numbers sum to less than b / max |p|.
    """
    sought = pull = reach = 0.0
    for k in range(len(y)):
        sought += y[k] * side_sign[k] * side_limit[k]
    for k in range(len(kkt.rows)):
        sought -= dual[kkt.rows[k]] * lower[kkt.rows[k]]
    for k in range(len(free)):
        pull = max(pull, abs(full[free[k]]))
        reach += abs(step[k])
    return sought > FARTHEST * pull * (1.0 + reach)


@compiled
def _residual(
    terms: TermArrays,
    kkt: KktArrays,
    free: IntArray,
    hessian: Array,
    gradient: Array,
    jacobian: Array,
    lower: Array,
    linear: Array,
    row_terms: Array,
    step: Array,
    full: Array,
    right: Array,
) -> None:
    """Minus the gradient of the Lagrangian, then minus the equality rows."""
    n = kkt.size[0]
    full[:] = 0.0
    transposed_times(terms, False, jacobian, row_terms, full)
    multiply(kkt, hessian, step, right)
    for k in range(n):
        right[k] = -(right[k] + gradient[k] + full[free[k]])
    for k in range(len(kkt.rows)):
        right[n + k] = lower[kkt.rows[k]] - linear[kkt.rows[k]]


@compiled
def multiply(kkt: KktArrays, hessian: Array, step: Array, out: Array) -> None:
    """H d into the first entries of ``out``."""
    out[:] = 0.0
    for k in range(len(hessian)):
        row, column = kkt.normal_row[k], kkt.normal_column[k]
        out[row] += hessian[k] * step[column]
        if row != column:
            out[column] += hessian[k] * step[row]
