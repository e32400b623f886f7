"""PIQP, called directly: a proximal interior point with a workspace per solve.

Takes 7-20 iterations where OSQP may take hundreds, and says so when a problem is
infeasible. :class:`PiqpRoute` solves the subproblem, :class:`ElasticRoute` its relaxation for linearised constraints
that contradict each other.
"""

from __future__ import annotations

import numpy as np
import piqp
import scipy.sparse as sp

from unifg.elimination.symmetric import Symmetric
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer, qp_error
from unifg.typing import Array, BoolArray, IntArray

INFINITY = 1e30  # PIQP treats larger limits as absent
TIGHTEST = 1e-12
LOOSEST = 1e-7
SLACK_CURVATURE = 1e-8
LEAST_PRICE = 1e3  # of violation, in the unit of the costs


def new_solver() -> piqp.SparseSolver:
    """A PIQP workspace with the settings both routes share."""
    solver = piqp.SparseSolver()
    solver.settings.eps_rel = 0.0
    solver.settings.eps_duality_gap_rel = 0.0
    solver.settings.max_iter = 60
    return solver


def limited(qp: QP) -> tuple[Array, Array, Array, BoolArray]:
    """Entries of A, limits and which rows have any; rows without are emptied, which PIQP would do with a complaint."""
    has = (qp.lower > -INFINITY) | (qp.upper < INFINITY)
    constraints = qp.program.constraints
    entries = constraints.compress(qp.jacobian)
    if has.all():
        return entries, np.maximum(qp.lower, -INFINITY), np.minimum(qp.upper, INFINITY), has
    lower, upper = np.maximum(qp.lower, -INFINITY), np.minimum(qp.upper, INFINITY)
    return entries * has[constraints.indices], np.where(has, lower, -1.0), np.where(has, upper, 1.0), has


class PiqpRoute:
    """The subproblem itself; equalities are eliminated from the inequalities' pattern.

    The workspace lasts for a solve; when data turn an inequality into an equality it is rebuilt.

    Attributes:
        name: "piqp".
    """

    name = "piqp"

    def __init__(self, program: CompiledProblem) -> None:
        """Remember the pattern; PIQP is set up with the first numbers."""
        self.program = program
        self._solver: piqp.SparseSolver | None = None

    def begin(self) -> None:
        """Drop the workspace: an update leaves roundings of earlier numbers in PIQP's scaling."""
        self._solver = None

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve to ``accuracy`` and measure; interior points start cold, so ``multipliers`` are not used."""
        equal = qp.lower == qp.upper
        fresh = self._solver is None or not np.array_equal(equal, self._equal)
        if fresh:
            self._hessian = qp.pattern.matrix(np.zeros(qp.pattern.nnz))
            self._split(equal)
        assert self._solver is not None
        unit = qp.unit
        self._solver.settings.eps_abs = float(np.clip(0.01 * accuracy / min(1.0, unit), TIGHTEST, LOOSEST))
        entries, lower, upper, has = limited(qp)
        self._hessian.data[:] = qp.hessian / unit
        self._equalities.data[:] = entries[self._equality_entries]
        self._inequalities.data[:] = entries[self._inequality_entries]
        numbers = {
            "P": self._hessian,
            "c": qp.gradient / unit,
            "A": self._equalities,
            "b": lower[equal],
            "G": self._inequalities,
            "h_l": lower[~equal],
            "h_u": upper[~equal],
        }
        if fresh:
            self._solver.setup(**numbers)
        else:
            self._solver.update(**numbers)
        status = self._solver.solve()
        result = self._solver.result
        iterations = int(result.info.iter)
        if status in (piqp.PIQP_PRIMAL_INFEASIBLE, piqp.PIQP_DUAL_INFEASIBLE):
            zero = np.zeros(self.program.size)
            return QPAnswer(
                zero, multipliers, self.name, iterations, np.inf, infeasible=status == piqp.PIQP_PRIMAL_INFEASIBLE
            )
        step, dual = np.array(result.x), np.zeros(len(equal))
        dual[equal] = unit * np.asarray(result.y)
        dual[~equal] = unit * (np.asarray(result.z_u) - np.asarray(result.z_l))
        dual[~has] = 0.0
        return QPAnswer(step, dual, self.name, iterations, qp_error(qp, step, dual))

    def _split(self, equal: BoolArray) -> None:
        """Find which entries of A belong to equalities, and start a new workspace."""
        self._equal = equal.copy()
        self._equality_entries, self._equalities = self._part(equal)
        self._inequality_entries, self._inequalities = self._part(~equal)
        self._solver = new_solver()

    def _part(self, rows: BoolArray) -> tuple[IntArray, sp.csc_matrix]:
        """Positions of the entries of chosen rows, and the matrix they make."""
        constraints = self.program.constraints
        chosen = np.flatnonzero(rows[constraints.indices])
        place = np.cumsum(rows) - 1
        column = np.repeat(np.arange(self.program.size), np.diff(constraints.indptr))[chosen]
        indptr = np.searchsorted(column, np.arange(self.program.size + 1))
        matrix = sp.csc_matrix(
            (np.zeros(len(chosen)), place[constraints.indices[chosen]], indptr),
            shape=(int(rows.sum()), self.program.size),
        )
        return chosen, matrix


class ElasticRoute:
    """The subproblem with constraints, but not bounds on unknowns, violated at a price per unit.

    With a price above the multipliers its step is that of the subproblem wherever that one is feasible;
    elsewhere it violates the linearised rows least.
    """

    def __init__(self, program: CompiledProblem, hessian: Symmetric) -> None:
        """Lay out d, and two slacks for every row that may be violated.

        Args:
            program: the compiled graph.
            hessian: pattern of H.
        """
        self.program = program
        self._entries = hessian.nnz
        n, constraints = program.size, program.constraints
        rows = np.flatnonzero(~program.bound_rows)
        m = len(rows)
        diagonal = np.arange(n, n + 2 * m)
        self._hessian = sp.csc_matrix(
            (
                np.concatenate([np.zeros(hessian.nnz), np.full(2 * m, SLACK_CURVATURE)]),
                np.concatenate([hessian.indices, diagonal]),
                np.concatenate([hessian.indptr, hessian.nnz + 1 + np.arange(2 * m)]),
            ),
            shape=(n + 2 * m, n + 2 * m),
        )
        self._rows = sp.csc_matrix(
            (
                np.concatenate([np.zeros(constraints.nnz), np.ones(m), -np.ones(m)]),
                np.concatenate([constraints.indices, rows, rows]),
                np.concatenate([constraints.indptr, constraints.nnz + 1 + np.arange(2 * m)]),
            ),
            shape=(constraints.count, n + 2 * m),
        )
        self._slacks = 2 * m
        self._solver: piqp.SparseSolver | None = None

    def begin(self) -> None:
        """Drop the workspace, as above."""
        self._solver = None

    def solve(self, qp: QP, price: float) -> QPAnswer:
        """Solve at a price, at least :data:`LEAST_PRICE`; the error is zero when PIQP converged, infinite otherwise."""
        program, n, unit = self.program, self.program.size, max(1.0, qp.unit)
        price = max(price, LEAST_PRICE * unit)
        self._hessian.data[: self._entries] = qp.hessian / unit
        self._rows.data[: program.constraints.nnz], lower, upper, has = limited(qp)
        numbers = {
            "P": self._hessian,
            "c": np.concatenate([qp.gradient, np.full(self._slacks, price)]) / unit,
            "G": self._rows,
            "h_l": lower,
            "h_u": upper,
            "x_l": np.concatenate([np.full(n, -INFINITY), np.zeros(self._slacks)]),
            "x_u": np.full(n + self._slacks, INFINITY),
        }
        if self._solver is None:
            self._solver = new_solver()
            self._solver.settings.eps_abs = LOOSEST
            self._solver.setup(**numbers)
        else:
            self._solver.update(**numbers)
        status = self._solver.solve()
        result = self._solver.result
        step = np.array(result.x)[:n]
        dual = unit * np.where(has, np.asarray(result.z_u) - np.asarray(result.z_l), 0.0)
        solved = status == piqp.PIQP_SOLVED and np.isfinite(step).all() and np.isfinite(dual).all()
        return QPAnswer(step, dual, "elastic", int(result.info.iter), 0.0 if solved else np.inf)
