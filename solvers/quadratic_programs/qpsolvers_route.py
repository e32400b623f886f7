"""Any solver that qpsolvers knows, by name."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import scipy.sparse as sp

from unifg.errors import BackendError
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer, qp_error
from unifg.typing import Array

SETTINGS: dict[str, dict[str, Any]] = {
    "piqp": {"eps_abs": 1e-9, "eps_rel": 1e-10, "max_iter": 200},
    "clarabel": {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-10, "tol_feas": 1e-9},
    "proxqp": {"eps_abs": 1e-9},
    "osqp": {"eps_abs": 1e-8, "eps_rel": 0.0, "polishing": True},
}


def require_known(name: str) -> None:
    """Refuse a solver that qpsolvers does not know, or that is not installed.

    Raises:
        BackendError: naming the installed ones.
    """
    import qpsolvers  # and with it every solver it knows: not for those who ask for none of them

    if name not in qpsolvers.available_solvers:
        known = ", ".join(sorted({"elimination", "graph", *qpsolvers.available_solvers}))
        raise BackendError(f"QP solver '{name}' is not installed (there are: {known}); pip install 'qpsolvers[{name}]'")


class QpsolversRoute:
    """Solves through ``qpsolvers.solve_problem``; the workspace is rebuilt each time.

    Attributes:
        name: the solver's name.
    """

    def __init__(self, program: CompiledProblem, name: str) -> None:
        """Take the solver of a name that :func:`require_known` has let pass."""
        import qpsolvers

        self.program = program
        self.name = name
        self._dense = name in qpsolvers.dense_solvers and name not in qpsolvers.sparse_solvers

    def begin(self) -> None:
        """Nothing is left of a solve."""

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve and measure; ``multipliers`` and ``accuracy`` are not used: interior points start cold."""
        upper = qp.pattern.matrix(qp.hessian)
        hessian = (upper + sp.triu(upper, 1).T).tocsc()
        jacobian = self.program.constraints.matrix(qp.jacobian).tocsr()
        unit = qp.unit
        answer = self._solve(hessian / unit, qp.gradient / unit, jacobian, qp.lower, qp.upper)
        if answer is None:
            return QPAnswer(np.zeros(self.program.size), multipliers, self.name, 0, np.inf)
        step, dual, iterations = answer[0], unit * answer[1], answer[2]
        return QPAnswer(step, dual, self.name, iterations, qp_error(qp, step, dual))

    def _solve(
        self, hessian: sp.csc_matrix, gradient: Array, jacobian: sp.csr_matrix, lower: Array, upper: Array
    ) -> tuple[Array, Array, int] | None:
        equal = lower == upper
        above, below = (
            np.flatnonzero(~equal & np.isfinite(upper)),
            np.flatnonzero(~equal & np.isfinite(lower)),
        )
        fixed = np.flatnonzero(equal)
        inequalities = sp.vstack([jacobian[above], -jacobian[below]], format="csc") if len(above) + len(below) else None
        limits = np.concatenate([upper[above], -lower[below]]) if inequalities is not None else None
        equalities = jacobian[fixed].tocsc() if len(fixed) else None
        if self._dense:
            hessian = hessian.toarray()
            inequalities = None if inequalities is None else inequalities.toarray()
            equalities = None if equalities is None else equalities.toarray()
        import qpsolvers

        problem = qpsolvers.Problem(
            hessian, gradient, inequalities, limits, equalities, lower[fixed] if len(fixed) else None
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                solution = qpsolvers.solve_problem(problem, solver=self.name, **SETTINGS.get(self.name, {}))
            except (qpsolvers.QPError, ValueError, ArithmeticError):
                return None
        if not solution.found or solution.x is None:
            return None
        dual = np.zeros(len(lower))
        if solution.z is not None and len(solution.z):
            np.add.at(dual, above, solution.z[: len(above)])
            np.add.at(dual, below, -solution.z[len(above) :])
        if solution.y is not None and len(solution.y):
            dual[fixed] = solution.y
        iterations = int(getattr((solution.extras or {}).get("info"), "iter", 0))
        return np.asarray(solution.x, dtype=np.float64), dual, iterations
