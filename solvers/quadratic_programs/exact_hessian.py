"""Subproblems with the Hessian of the Lagrangian (Ta et al. 2014, eq. 18), and when they may have it.

Newton's method on the KKT conditions needs H as it is: clipping the eigenvalues of every block makes it convex and its
convergence linear. A step of descent exists when H is positive definite where the linearised constraints leave freedom,
which the inertia of the KKT matrix tells: as many positive pivots as unknowns, as many negative ones as multipliers.
Then squares of the constraints with enough weight make H positive definite without moving the solution (Debreu,
Econometrica 20 (1952)). Where the inertia is wrong even with the active inequalities held, Gauss-Newton's Hessian
stands in for that one step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import add_constraints
from unifg.problem.linearization import Linearization
from unifg.problem.systems import KktSystem, fill
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer, subproblem
from unifg.typing import Array, BoolArray

SHIFT = 1e-10  # on the diagonal of the scaled KKT matrix, so that no order of elimination meets a vanishing pivot
WEIGHTS = (1.0, 10.0, 1e2, 1e3, 1e4, 1e6)  # tried in turn, relative to curvature over squared slope


class ExactHessian:
    """Makes subproblems with the Hessian of the Lagrangian for one prepared graph."""

    def __init__(self, program: CompiledProblem) -> None:
        """Remember the program; structures are analysed when first needed."""
        self.program = program
        self._definite = program.systems.normal()
        self._system: KktSystem | None = None

    def subproblem(self, lin: Linearization, multipliers: Array, damping: float | Array, scaling: Scaling) -> QP:
        """The quadratic model at ``lin``, in the pattern ``CompiledProblem.normal``.

        Args:
            lin: where.
            multipliers: (M,) the Lagrangian's.
            damping: added to the diagonal of H, a number or (n,).
            scaling: units in which curvatures and slopes are compared.

        Returns:
            The exact model, with the weights that make it convex if it needs them, or Gauss-Newton's.
        """
        program = self.program
        simple = subproblem(program, lin, damping, program.normal)
        exact = simple.with_curvature(multipliers)
        if not np.isfinite(exact.hessian).all():
            return simple
        scaled = scaling.scaled(exact)
        if self._is_definite(scaled.hessian):
            return exact
        held = program.equality.copy()
        unit = self._unit(scaled)
        if not self._inertia_is_right(scaled, np.zeros(len(unit))):
            active = active_inequalities(program, lin, multipliers)
            if not active.any() or not any(
                self._inertia_is_right(scaled, np.where(active, weight * unit, 0.0)) for weight in WEIGHTS
            ):
                return simple
            held |= active
        for weight in WEIGHTS:
            weights = np.where(held, weight * unit, 0.0)
            if self._is_definite(self._with_squares(scaled, weights)):
                return replace(exact, weights=weights * scaling.rows**2.0)
        return simple

    def _is_definite(self, hessian: Array) -> bool:
        return self._definite.factor(hessian) and self._definite.definite

    def _inertia_is_right(self, qp: QP, weights: Array) -> bool:
        """Test whether H with squares of the weighted rows is positive definite where the equalities leave freedom."""
        program, n = self.program, self.program.size
        if self._system is None or not np.array_equal(self._system.held, program.equality):
            self._system = program.systems.kkt(program.equality)
        system = self._system
        data, shift = np.zeros(system.pattern.nnz), np.zeros(system.pattern.size)
        fill(system.arrays, self._with_squares(qp, weights), qp.jacobian, data)
        curvature = float(np.abs(qp.hessian).max(initial=0.0)) or 1.0
        slope = float(np.abs(qp.jacobian).max(initial=0.0)) or 1.0
        shift[:n], shift[n:] = SHIFT * curvature, -SHIFT * slope**2 / curvature
        return system.factorization.factor(data, shift) and system.factorization.inertia == (n, len(shift) - n, 0)

    def _with_squares(self, qp: QP, weights: Array) -> Array:
        """H + A' diag(weights) A."""
        entries = qp.hessian.copy()
        add_constraints(self.program.arrays, qp.jacobian, weights, entries)
        return entries

    def _unit(self, qp: QP) -> Array:
        """(M,) weight at which the square of a row has the largest curvature of H; zero for rows without a slope."""
        constraints = self.program.constraints
        entries = qp.jacobian[constraints.free]
        squares = np.bincount(constraints.free_rows, weights=entries**2, minlength=constraints.count)
        size = float(np.abs(qp.hessian).max(initial=0.0)) or 1.0
        return np.divide(size, squares, out=np.zeros(constraints.count), where=squares > 0.0)


def active_inequalities(program: CompiledProblem, lin: Linearization, multipliers: Array) -> BoolArray:
    """(M,) inequalities whose multiplier outweighs the distance to the limit it points at."""
    limit = np.where(multipliers > 0.0, program.upper, program.lower)
    distance = np.where(np.isfinite(limit), np.abs(lin.constraints - limit), np.inf)
    active: BoolArray = ~program.equality & (np.abs(multipliers) > distance)
    return active


def holds(qp: QP, answer: QPAnswer, accuracy: float) -> bool:
    """Test whether the inequalities whose squares were added are active in the answer, as was assumed.

    One that is not would need a multiplier of the wrong sign to undo its square.
    """
    if qp.weights is None:
        return True
    assumed = (qp.weights > 0.0) & (qp.lower != qp.upper)
    dual, value = answer.multipliers[assumed], qp.linear(answer.step)[assumed]
    limit = np.where(dual > 0.0, qp.upper[assumed], qp.lower[assumed])
    slack = np.where(np.isfinite(limit), np.abs(value - limit), 1.0)
    return bool((np.abs(dual) * slack <= accuracy).all())
