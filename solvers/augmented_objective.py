"""The objective of the augmented Lagrangian, its gradient, and a Gauss-Newton direction.

The Powell-Hestenes-Rockafellar term of a row with multiplier lambda and penalty rho is (lambda+^2 - lambda^2) /
(2 rho), where lambda+ is the multiplier the dual step would produce. An inactive inequality contributes nothing
(Bazzana's eq. 19 read literally would keep penalising it). Without constraints the objective is f itself: the
least-squares backends descend on the same.
"""

from __future__ import annotations

from functools import cached_property
from operator import is_
from typing import NamedTuple

import numpy as np

from unifg.codegen.function_pointers import Memory, all_of, linked_to
from unifg.codegen.inner import inner
from unifg.codegen.jit import compiled, inlined
from unifg.elimination.plan import Plan
from unifg.modeling.terms import Constraint
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import times, transposed_times
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.linearization import Evaluation, Linearization
from unifg.problem.table import TermArrays
from unifg.typing import Array, BoolArray, IntArray

DIAGONAL_FLOOR = 1e-9  # of the largest diagonal entry: damping must act on unknowns with little curvature too
ROUNDED = 1e-28  # of the largest diagonal entry: less is the square of what rounding leaves in a column


class Held(NamedTuple):
    """Arrays that stay where they are from step to step.

    Attributes:
        terms: of the program.
        plan: of the elimination of the normal equations.
        free: columns that are unknown.
        indptr, indices: pattern of the normal matrix.
        equality: (M,) which rows are.
    """

    terms: TermArrays
    plan: Plan
    free: IntArray
    indptr: IntArray
    indices: IntArray
    equality: BoolArray


arrays = Memory()  # of Held: Numba takes ten microseconds to unpack it in every call
held = all_of(arrays)


class Primal:
    """Merit, gradient and Gauss-Newton direction of the augmented objective.

    Attributes:
        program: the compiled graph.
        solver: factorisation of the normal equations.
        damping: what was added to the diagonal of the matrix factorised last, relative to it.
        curvatures: (n,) what damping is relative to, the largest diagonal seen so far; empty for the present one.
        hopeful: whether the next trial is linearised at once, since it will probably be taken.
        reached: what came of that.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Analyse the structure of the normal equations."""
        self.program = program
        self.solver = program.systems.normal()
        self.damping = 0.0
        self.curvatures: Array = np.zeros(0)
        self.hopeful = False
        self.reached: Linearization | None = None
        self._held: tuple[object, ...] = (None,)  # nothing is that, so that the first call describes

    def prices(self, lin: Linearization) -> Array:
        """(M,) multipliers by which slacks of soft constraints stay where they are: without, a first step is lost."""
        multipliers = np.zeros(self.program.constraints.count)
        for term, rows in zip(self.program.constraint_terms, self.program.slices, strict=True):
            if isinstance(term.term, Constraint) and term.term.limits_slacks:
                multipliers[rows] = -lin.gradient[np.concatenate(term.columns, axis=1).ravel()]
        return multipliers

    @property
    def address(self) -> int:
        """Address of the description of :class:`Held` at present; limits and terms may be new ones with new data."""
        program, normal = self.program, self.program.normal
        present = Held(
            program.arrays, self.solver.plan, program.columns.free, normal.indptr, normal.indices, program.equality
        )
        if not all(map(is_, present, self._held)):
            self._held, self._words = present, arrays.describe(present)
            self._address = int(self._words.ctypes.data)
        return self._address

    @cached_property
    def alike(self) -> IntArray:
        """(M,) number of the first row of the same term that means the same in another factor."""
        parts = [np.zeros(0, dtype=np.intp)]
        for term, rows in zip(self.program.constraint_terms, self.program.slices, strict=True):
            parts.append(rows.start + np.tile(np.arange(term.size), term.count))
        return np.concatenate(parts)

    def next_multipliers(self, constraints: Array, multipliers: Array, penalty: Array) -> Array:
        """(M,) lambda+: the first-order dual update, zero for inactive rows."""
        after = np.empty(len(multipliers))
        update(constraints, self.program.lower, self.program.upper, multipliers, penalty, after)
        return after

    def merit(self, point: Evaluation | Linearization, multipliers: Array, penalty: Array) -> float:
        """Augmented objective."""
        program = self.program
        return point.cost + float(barrier(point.constraints, program.lower, program.upper, multipliers, penalty))

    def gradient(self, lin: Linearization, multipliers: Array, penalty: Array) -> Array:
        """Gradient of the augmented objective over the unknowns."""
        after = self.next_multipliers(lin.constraints, multipliers, penalty)
        return self.program.lagrangian_gradient(lin, after)[self.program.columns.free]

    def rounding(self, lin: Linearization, multipliers: Array, penalty: Array) -> float:
        """Change of :meth:`merit` by one unit in the last place of every coordinate.

        Far from the origin, as in map coordinates, this is more than the last steps of a solve can gain.
        """
        program = self.program
        after = self.next_multipliers(lin.constraints, multipliers, penalty)
        pull = program.costs.transposed_times(np.abs(lin.jacobian), np.abs(lin.residual))
        pull += program.constraints.transposed_times(np.abs(lin.constraint_jacobian), np.abs(after))
        size = np.concatenate([np.repeat(np.abs(lin.values[f]).max(axis=1), f.manifold.dim) for f in program.families])
        return float(np.finfo(np.float64).eps * inner(pull, size))

    def slope(self, lin: Linearization, multipliers: Array) -> float:
        """Largest entry of the Lagrangian's gradient over the unknowns."""
        return float(slope_of(self.address, lin.gradient, lin.constraint_jacobian, multipliers))

    def curvature(self, lin: Linearization, multipliers: Array, penalty: Array) -> Array:
        """Gauss-Newton Hessian entries J'J + A' diag(rho, active rows) A."""
        after = self.next_multipliers(lin.constraints, multipliers, penalty)
        active = self.program.equality | (after != 0.0)
        return self.program.normal_entries(lin, np.where(active, penalty, 0.0))

    def expected_multipliers(
        self, lin: Linearization, step: Array, multipliers: Array, penalty: Array, base: Array
    ) -> Array:
        """(M,) lambda+ after a step, by the linear model of the constraints that are ``base`` without a step."""
        after = np.empty(len(multipliers))
        expect(self.address, lin.constraint_jacobian, step, base, multipliers, penalty, after)
        return after

    def bend(self, lin: Linearization, multipliers: Array) -> Array:
        """Second-order terms that :meth:`curvature` omits: second derivatives of residuals and constraints.

        Empty where there are none, and where they are not finite: a factor may have a kink or a pole there.
        """
        left_out: Array = lagrangian_hessian(self.program, lin, multipliers)
        return left_out if _subtract(left_out, lin.hessian) else np.zeros(0)

    def direction(self, curvature: Array, gradient: Array) -> Array | None:
        """Solve H d = -gradient; None when the matrix cannot be factorised."""
        self.damping = 0.0
        if not self.solver.factor(curvature):
            return None
        step = -self.solver.solve(gradient)
        return step if np.isfinite(step).all() else None

    def remember(self, lin: Linearization, anew: bool = False) -> None:
        """Raise :attr:`curvatures` to the diagonal of the Hessian.

        An unknown that a step has taken to where the measurements hardly see it is damped as before, so that it is not
        taken farther still (More 1978). Nothing is compared with other unknowns, which may have other units, but to
        tell curvature from rounding.

        Args:
            lin: where.
            anew: forget what was seen before.
        """
        diagonal = lin.hessian[self.program.normal.diagonal]
        largest = diagonal.max(initial=0.0)
        seen = np.where(diagonal > ROUNDED * largest, diagonal, DIAGONAL_FLOOR * largest + 1e-300)
        self.curvatures = seen if anew else np.maximum(seen, self.curvatures)

    def trial(self, lin: Linearization, step: Array) -> tuple[Values, Evaluation | Linearization]:
        """Values after ``step`` and what they cost, with the weights of ``lin`` held."""
        values = self.program.retract(lin.values, step)
        if self.hopeful and not self.program.table.holding:
            self.hopeful, self.reached = False, self.program.linearize(values)
            return values, self.reached
        return values, self.program.evaluate(values, lin.weights)

    def linearized(self, values: Values) -> Linearization:
        """Linearisation at the values of a step, which may be at hand since its trial."""
        found = self.reached
        return found if found is not None and found.values is values else self.program.linearize(values)


@compiled
def _subtract(entries: Array, others: Array) -> bool:
    """Subtract in place; True if the results are finite and not all zero."""
    largest = 0.0
    for k in range(len(entries)):
        entries[k] -= others[k]
        if not abs(entries[k]) < np.inf:
            return False
        largest = max(largest, abs(entries[k]))
    return largest > 0.0


@linked_to(arrays)
def expect(
    where: int, entries: Array, step: Array, base: Array, multipliers: Array, penalty: Array, out: Array
) -> None:
    """Write lambda+ after a step, by the linear model of the constraints that are ``base`` without a step.

    Base and limit are subtracted before the step is added, so that a large penalty finds no rounding to multiply.
    """
    terms = held(where).terms
    moved = np.empty_like(base)
    times(terms, False, entries, step, moved)
    update(moved, terms.lower - base, terms.upper - base, multipliers, penalty, out)


@linked_to(arrays)
def slope_of(where: int, gradient: Array, entries: Array, multipliers: Array) -> float:
    """Max |gradient + A' multipliers| over the unknowns; NaN where one is."""
    known = held(where)
    full, largest = gradient.copy(), 0.0
    transposed_times(known.terms, False, entries, multipliers, full)
    for k in range(len(known.free)):
        size = abs(full[known.free[k]])
        if size != size:
            return np.nan
        largest = max(largest, size)
    return largest


@inlined
def _after(value: float, lower: float, upper: float, multiplier: float, penalty: float) -> float:
    """lambda+ of one row; NaN stays visible."""
    above, below = multiplier + penalty * (value - upper), multiplier + penalty * (value - lower)
    updated = (above if above > 0.0 else 0.0) + (below if below < 0.0 else 0.0)
    return updated if value == value else value


@compiled
def update(constraints: Array, lower: Array, upper: Array, multipliers: Array, penalty: Array, out: Array) -> None:
    """Write lambda+: the first-order dual update, zero for inactive rows."""
    for row in range(len(out)):
        out[row] = _after(constraints[row], lower[row], upper[row], multipliers[row], penalty[row])


@compiled
def barrier(constraints: Array, lower: Array, upper: Array, multipliers: Array, penalty: Array) -> float:
    """Sum of the terms."""
    total = 0.0
    for row in range(len(constraints)):
        after = _after(constraints[row], lower[row], upper[row], multipliers[row], penalty[row])
        total += (after * after - multipliers[row] * multipliers[row]) / (2.0 * penalty[row])
    return total
