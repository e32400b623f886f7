"""Quadratic subproblems by elimination on the graph: one linear system, or an interior point over such systems.

Without inequalities the subproblem is the KKT system itself. With them, Mehrotra's predictor-corrector method (SIAM J.
Optim. 2 (1992)) solves two systems with one factorisation per iteration; every finite limit is a side v >= 0 with slack
s and multiplier y. After the first subproblem of a solve it begins from the last multipliers and from the slacks of no
step, both at least `WARM`: between subproblems the active set changes little, and iterations halve.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.elimination.fronts import factor
from unifg.elimination.substitution import solve
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import add_constraints, times, transposed_times
from unifg.problem.systems import KktArrays, fill
from unifg.problem.table import TermArrays
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer, qp_error
from unifg.typing import Array, BoolArray, IntArray

ITERATIONS = 60
TIGHTEST = 1e-12  # accuracy
WARM = 1e-2  # least slacks and multipliers of an interior point that begins from the last multipliers
BOUNDARY = 0.995  # fraction of the way to the boundary
SHIFT = 1e-10  # keeps the KKT matrix quasi-definite, relative to nothing: rows are in the problem's own units
RESIDUAL = 1e-8  # relative, of a linear system without a solution: the rows contradict each other
HOPELESS = 1e9  # multipliers beyond this mean that the rows contradict each other


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

    def begin(self) -> None:
        """Nothing is left of a solve."""

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve to ``accuracy`` from the step zero and ``multipliers``, and measure."""
        program = self.program
        equality = qp.lower == qp.upper
        if not np.array_equal(equality, self.system.held):
            self.system = program.systems.kkt(equality)
        below = np.flatnonzero(np.isfinite(qp.lower) & ~equality)
        above = np.flatnonzero(np.isfinite(qp.upper) & ~equality)
        step, dual = np.zeros(program.size), multipliers.copy()
        hessian = qp.hessian
        if qp.pattern is not program.normal:
            hessian = np.zeros(program.normal.nnz)
            hessian[program.objective_places] = qp.hessian
        if not len(below) and not len(above):
            error = self._linear(qp, hessian, dual, step)
            return QPAnswer(step, dual, self.name, 1, qp_error(qp, step, dual), not error <= RESIDUAL)
        iterations = int(
            minimize_quadratic(
                program.arrays,
                self.system.arrays,
                program.columns.free,
                hessian,
                qp.gradient,
                qp.jacobian,
                np.concatenate([below, above]),
                np.repeat([1.0, -1.0], [len(below), len(above)]),
                np.concatenate([qp.lower[below], qp.upper[above]]),
                qp.lower,
                equality,
                max(accuracy, TIGHTEST),
                bool(multipliers.any()),
                step,
                dual,
            )
        )
        infeasible = bool(np.abs(dual).max(initial=0.0) > HOPELESS) or iterations < 0
        return QPAnswer(step, dual, self.name, abs(iterations), qp_error(qp, step, dual), infeasible)

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
def minimize_quadratic(
    terms: TermArrays,
    kkt: KktArrays,
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
    warm: bool,
    step: Array,
    dual: Array,
) -> float:
    """Mehrotra's method from step zero and `dual`; returns the iterations, negative when a system was singular."""
    n, equalities, sides, count = kkt.size[0], kkt.size[1], len(side_row), len(lower)
    linear, row_terms, weights, move = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    full, data = np.zeros(len(terms.unknown)), np.zeros(len(kkt.plan.slots))
    right, found, shift = np.zeros(n + equalities), np.zeros(n + equalities), np.zeros(n + equalities)
    shift[:n], shift[n:] = SHIFT, -SHIFT
    matrix = np.empty_like(hessian)
    s, y, ds, dy, target = np.ones(sides), np.ones(sides), np.zeros(sides), np.zeros(sides), np.zeros(sides)
    least = WARM if warm else 1.0
    for k in range(sides):
        s[k] = max(least, -side_sign[k] * side_limit[k])
        y[k] = max(least, -side_sign[k] * dual[side_row[k]])
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
            break
        weights[:] = 0.0
        for k in range(sides):
            weights[side_row[k]] += y[k] / s[k]
        copy_to(hessian, matrix)
        add_constraints(terms, jacobian, weights, matrix)
        fill(kkt, matrix, jacobian, data)
        if not factor(kkt.plan, data, shift):
            return -iteration - 1.0
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
            return -iteration - 1.0
        for k in range(equalities):
            dual[kkt.rows[k]] += length * found[n + k]
        for k in range(sides):
            s[k] += length * ds[k]
            y[k] += length * dy[k]
    for k in range(sides):
        dual[side_row[k]] -= side_sign[k] * y[k]
    return float(iteration)


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
    _symmetric(kkt, hessian, step, right)
    for k in range(n):
        right[k] = -(right[k] + gradient[k] + full[free[k]])
    for k in range(len(kkt.rows)):
        right[n + k] = lower[kkt.rows[k]] - linear[kkt.rows[k]]


@compiled
def _symmetric(kkt: KktArrays, hessian: Array, step: Array, out: Array) -> None:
    """H d into the first entries of ``out``."""
    out[:] = 0.0
    for k in range(len(hessian)):
        row, column = kkt.normal_row[k], kkt.normal_column[k]
        out[row] += hessian[k] * step[column]
        if row != column:
            out[column] += hessian[k] * step[row]
