"""OSQP, called directly: one workspace per structure, updated and warm-started in primal and dual.

OSQP accepts wrong sizes, crossed limits and NaN without raising and fills x with numbers near 1e9 when a problem
is infeasible, so nothing it returns is used before :func:`unifg.solvers.qp.qp_error` has measured it. The step
size rho is adapted at fixed iterations, never by the clock: equal inputs give equal answers. Polishing is left
off without equalities: it would print to the terminal whenever no limit is active.
"""

from __future__ import annotations

import numpy as np
import osqp

from unifg.program import Program
from unifg.solvers.qp import QP, QPAnswer, qp_error
from unifg.typing import Array

INFINITY = 1e20  # OSQP treats larger limits as absent
TIGHTEST = 1e-9


class OsqpRoute:
    """A persistent OSQP workspace.

    Attributes:
        name: "osqp".
    """

    name = "osqp"

    def __init__(self, program: Program, max_iterations: int) -> None:
        """Remember the pattern; OSQP is set up with the first numbers."""
        self.program = program
        self.max_iterations = max_iterations
        self._workspace: osqp.OSQP | None = None
        self._accuracy = 0.0

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve to ``accuracy``, polish, and measure."""
        nothing = QPAnswer(np.zeros(self.program.size), multipliers, self.name, 0, np.inf)
        if (qp.lower >= INFINITY).any() or (qp.upper <= -INFINITY).any():
            return nothing  # OSQP would print that the limits cross
        try:
            return self._solve(qp, multipliers, max(accuracy, TIGHTEST))
        except osqp.OSQPException:  # a matrix so large that its rounding errors are not convex
            self._workspace = None
            return nothing

    def _solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        lower, upper = np.maximum(qp.lower, -INFINITY), np.minimum(qp.upper, INFINITY)
        if self._workspace is None:
            self._workspace = osqp.OSQP()
            self._workspace.setup(
                P=qp.pattern.matrix(qp.hessian),
                q=qp.gradient,
                A=self.program.constraints.matrix(qp.jacobian),
                l=lower,
                u=upper,
                verbose=False,
                eps_abs=accuracy,
                eps_rel=0.0,
                max_iter=self.max_iterations,
                polishing=bool((qp.lower == qp.upper).any()),
                adaptive_rho_interval=50,
                check_termination=25,
            )
            self._accuracy = accuracy
        else:
            self._workspace.update(
                q=qp.gradient,
                l=lower,
                u=upper,
                Px=qp.hessian,
                Ax=self.program.constraints.compress(qp.jacobian),
            )
            if accuracy != self._accuracy:
                self._workspace.update_settings(eps_abs=accuracy)
                self._accuracy = accuracy
        self._workspace.warm_start(x=np.zeros(self.program.size), y=multipliers)
        result = self._workspace.solve(raise_error=False)
        status = result.info.status_val
        solved = osqp.SolverStatus.OSQP_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE
        if status in (*solved, osqp.SolverStatus.OSQP_MAX_ITER_REACHED):
            step, dual = np.array(result.x), np.array(result.y)
            return QPAnswer(step, dual, self.name, int(result.info.iter), qp_error(qp, step, dual))
        infeasible = status in (
            osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE,
            osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE,
        )
        zero = np.zeros(self.program.size)
        return QPAnswer(zero, multipliers, self.name, int(result.info.iter), np.inf, infeasible)
