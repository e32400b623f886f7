"""The quadratic subproblem of an SQP step, and how its answers are judged.

    minimise 1/2 d'Hd + g'd   subject to   lower <= A d <= upper

Whatever route solves it, the answer is measured here, in the problem's own units, before it is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.symmetric import Symmetric
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import add_constraints
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.linearization import Linearization, all_finite
from unifg.problem.units import cost_size
from unifg.solvers.globalize.norms import geometric_mean, largest
from unifg.typing import Array, BoolArray

LEFT = 0.3  # share of the violation that a step may leave in the linear model
LARGE = 2.0**7  # curvature that is taken out of the costs
FINER = 0.01  # than the accuracy asked for: what interior points reach, and OSQP with a polish or not at all


@dataclass(frozen=True)
class QP:
    """Numbers of one subproblem in the program's fixed patterns.

    A Hessian that is positive definite only where the linearised constraints leave freedom comes with ``weights``:
    with w/2 |A d - b|^2 added for the rows they name, H becomes positive definite, and the solution stays what it is;
    see :meth:`convex`.

    Attributes:
        program: gives the pattern ``constraints`` (A).
        lin: where the problem was linearised.
        pattern: of H: ``CompiledProblem.hessian``, or ``CompiledProblem.normal`` when H may hold second-order terms.
        hessian: entries of H, upper triangle.
        gradient: (n,) g.
        jacobian: entries of A in evaluation order.
        lower, upper: (M,) limits on A d.
        damping: what H has on its diagonal beyond the model's own curvature, a number or (n,).
        curved_by: (M,) multipliers whose curvature H contains; None for the Hessian of Gauss-Newton.
        weights: (M,) w, zero for rows without a square; None when H needs none.
    """

    program: CompiledProblem
    lin: Linearization
    pattern: Symmetric
    hessian: Array
    gradient: Array
    jacobian: Array
    lower: Array
    upper: Array
    damping: float | Array = 0.0
    curved_by: Array | None = None
    weights: Array | None = None

    @property
    def unit(self) -> float:
        """Size of the costs below 1, or their mean curvature if large: absolute tolerances are for costs over it."""
        size = float(cost_size(self.program.normal.diagonal, self.lin.hessian, self.lin.gradient))
        mean = geometric_mean(np.abs(self.hessian[self.pattern.diagonal]))
        return mean if size == 1.0 and mean > LARGE else size

    def curved(self, step: Array) -> Array:
        """H d."""
        return self.pattern.times(self.hessian, step)

    def linear(self, step: Array) -> Array:
        """A d."""
        return self.program.constraints.times(self.jacobian, step)

    def shifted(self, offset: Array) -> QP:
        """The same problem with both limits moved by ``offset``."""
        return replace(self, lower=self.lower + offset, upper=self.upper + offset)

    def with_curvature(self, multipliers: Array) -> QP:
        """The same problem, in the pattern ``CompiledProblem.normal``, with the Hessian of the Lagrangian (Ta eq. 18).

        Args:
            multipliers: (M,).
        """
        pattern = self.program.normal
        hessian = lagrangian_hessian(self.program, self.lin, multipliers)
        hessian[pattern.diagonal] += self.damping
        return replace(self, pattern=pattern, hessian=hessian, curved_by=multipliers, weights=None)

    def gauss_newton(self) -> QP:
        """The same problem without the curvature of constraints and residuals."""
        hessian = _gauss_newton(self.program, self.lin, self.pattern, self.damping)
        return replace(self, hessian=hessian, curved_by=None, weights=None)

    @property
    def targets(self) -> Array:
        """(M,) b: the limit that each row with a weight is expected at, zero elsewhere."""
        if self.weights is None:
            return np.zeros(len(self.lower))
        assert self.curved_by is not None
        return np.where(self.weights > 0.0, np.where(self.curved_by > 0.0, self.upper, self.lower), 0.0)

    def convex(self) -> QP:
        """The problem with w/2 |A d - b|^2 added: H + A'WA and g - A'Wb.

        Where A d = b holds, the square and its gradient vanish: step and multipliers are those of this problem. Where
        a route misses A d = b, or gives it up, the multipliers differ by W (A d - b); see :func:`solve_convex`.
        """
        if self.weights is None:
            return self
        program = self.program
        hessian = self.hessian.copy()
        add_constraints(program.arrays, self.jacobian, self.weights, hessian)
        pull = program.constraints.transposed_times(self.jacobian, self.weights * self.targets)
        return replace(self, hessian=hessian, gradient=self.gradient - pull[program.columns.free], weights=None)


@dataclass
class QPAnswer:
    """A candidate solution.

    Attributes:
        step: (n,) d.
        multipliers: (M,) positive at an active upper limit, negative at an active lower one.
        route: name of what produced it.
        iterations: its iterations.
        error: largest KKT residual, see :func:`qp_error`; infinite when it does not exist.
        infeasible: whether the route claims that no feasible step exists.
    """

    step: Array
    multipliers: Array
    route: str
    iterations: int
    error: float
    infeasible: bool = False


class Route(Protocol):
    """A way of solving subproblems that share one pattern."""

    name: str

    def begin(self) -> None:
        """Forget what the last solve of the program has left."""

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve, starting from the step zero and ``multipliers`` if the route can."""


def qp_error(qp: QP, step: Array, multipliers: Array) -> float:
    """Largest of stationarity, infeasibility and complementarity, scaled as in :mod:`unifg.solution.optimality`."""
    if not (all_finite(step) and all_finite(multipliers)):
        return np.inf
    program = qp.program
    slope = qp.curved(step) + qp.gradient
    slope += program.constraints.transposed_times(qp.jacobian, multipliers)[program.columns.free]
    if program.least_squares:
        return largest(slope) / (largest(qp.gradient) or 1.0)  # measured without units there, and here
    return float(largest_residual(slope, qp.linear(step), qp.lower, qp.upper, multipliers, program.equality))


@compiled
def largest_residual(
    slope: Array, value: Array, lower: Array, upper: Array, multipliers: Array, equality: BoolArray
) -> float:
    """The same of a gradient of the Lagrangian and of values of the rows; infinite where one is not a number."""
    stationarity = infeasibility = complementarity = size = 0.0
    for entry in slope:
        if entry != entry:
            return np.inf
        stationarity = max(stationarity, abs(entry))
    for row in range(len(value)):
        if value[row] != value[row]:
            return np.inf
        size += abs(multipliers[row])
        infeasibility = max(infeasibility, max(value[row] - upper[row], lower[row] - value[row]))
        if not equality[row]:
            limit = upper[row] if multipliers[row] > 0.0 else lower[row]
            slack = abs(value[row] - limit) if math.isfinite(limit) else 1.0
            complementarity = max(complementarity, abs(multipliers[row]) * slack)
    scale = max(1.0, size / max(len(value), 1) / 100.0)
    return max(max(stationarity / scale, infeasibility), complementarity / scale)


@compiled
def leaves_most(linear: Array, lower: Array, upper: Array, small: float) -> bool:
    """Test whether a step leaves most of the violation, as the least error of contradicting rows does.

    Args:
        linear: (M,) A times the step.
        lower: (M,) limits on it.
        upper: the same.
        small: violation that counts as none.
    """
    before = after = 0.0
    for row in range(len(linear)):
        before = max(before, max(lower[row], 0.0) + max(-upper[row], 0.0))
        after = max(after, max(lower[row] - linear[row], 0.0) + max(linear[row] - upper[row], 0.0))
    return after > max(LEFT * before, small)


def solve_convex(route: Route, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
    """Let a route that asks for a positive definite H solve ``qp``.

    With y the multipliers of the convex problem, H d + A'W(A d - b) + g + A'y = 0 there, so those of ``qp`` are
    y + W (A d - b): the same, up to the route's own accuracy in A d = b. The error is that of ``qp``. The graph, which
    eliminates equalities, needs the squares of inequalities alone.
    """
    if qp.weights is not None and route.name == "graph":
        weights = np.where(qp.lower == qp.upper, 0.0, qp.weights)
        qp = replace(qp, weights=weights if weights.any() else None)
    if qp.weights is None:
        return route.solve(qp, multipliers, accuracy)
    finer = accuracy / max(1.0, float(qp.weights.max()))  # errors in A d = b count W times in the multipliers
    answer = route.solve(qp.convex(), multipliers, finer)
    if not np.isfinite(answer.error):
        return answer
    dual = answer.multipliers + qp.weights * (qp.linear(answer.step) - qp.targets)
    return replace(answer, multipliers=dual, error=qp_error(qp, answer.step, dual))


def subproblem(
    program: CompiledProblem, lin: Linearization, damping: float | Array, pattern: Symmetric | None = None
) -> QP:
    """The quadratic model at ``lin``, with Gauss-Newton's Hessian and ``damping`` on its diagonal.

    Args:
        program: the compiled graph.
        lin: where.
        damping: added to the diagonal of H, a number or (n,).
        pattern: of H, ``program.hessian`` (the default) or ``program.normal``.
    """
    pattern = program.hessian if pattern is None else pattern
    return QP(
        program,
        lin,
        pattern,
        _gauss_newton(program, lin, pattern, damping),
        lin.gradient[program.columns.free],
        lin.constraint_jacobian,
        program.lower - lin.constraints,
        program.upper - lin.constraints,
        damping,
    )


def _gauss_newton(program: CompiledProblem, lin: Linearization, pattern: Symmetric, damping: float | Array) -> Array:
    entries = lin.hessian.copy() if pattern is program.normal else program.hessian_entries(lin)
    entries[pattern.diagonal] += damping
    return entries
