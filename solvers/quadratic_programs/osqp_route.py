"""OSQP, called directly: one workspace per structure, updated and warm-started in primal and dual.

OSQP's first-order iterations find the active set soon and digits slowly, so it is asked for the former: one digit of a
problem brought to one scale (:mod:`unifg.solvers.quadratic_programs.scaling`). What it finds active is completed to the
accuracy asked for on the graph (:mod:`unifg.solvers.quadratic_programs.graph_route`). Where that does not settle,
OSQP goes on with one digit more and a polish of its own, until its iterations have cost what a few of an interior point
would. Equalities weigh three times as much as in OSQP's own choice, which is 1000 times the rho of inequalities.

Equal calls give equal answers: rho adapts at fixed iterations, never by the clock, and begins anew with every solve;
OSQP's own scaling, which would carry digits of one problem into the next, is off. Its test of the duality gap is off
too: complementarity is measured here, and a gap says little where limits are far.

OSQP accepts wrong sizes, crossed limits and NaN without raising and fills x with numbers near 1e9 when a problem
is infeasible, so nothing it returns is used before :func:`unifg.solvers.quadratic_programs.subproblem.qp_error` has
measured it. Polishing is left off without equalities: it would print to the terminal whenever no limit is active.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import osqp

from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.quadratic_programs.scaling import Packed
from unifg.solvers.quadratic_programs.subproblem import FINER, QP, QPAnswer, qp_error
from unifg.typing import Array

INFINITY = 1e20  # OSQP treats larger limits as absent
TIGHTEST = 1e-13
RHO, ALPHA = 0.1, 1.8
EQUALITIES = 2.0  # their rows are so much longer; rho goes with the square
DIGITS = 1e-1  # accuracy asked for at first, before the graph completes it
FINEST = 1e-9  # asked of the iterations; what lies beyond is left to the polish
EVERY = 5  # iterations between looks at it
WORTH = 30.0  # iterations of an interior point
SOLVED = (osqp.SolverStatus.OSQP_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE)
UNFINISHED = osqp.SolverStatus.OSQP_MAX_ITER_REACHED
INFEASIBLE = (osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE, osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE)


class OsqpRoute:
    """A persistent OSQP workspace.

    Attributes:
        name: "osqp".
    """

    name = "osqp"

    def __init__(self, program: CompiledProblem, max_iterations: int | None) -> None:
        """Remember the pattern; OSQP is set up with the first numbers.

        Args:
            program: the compiled graph.
            max_iterations: per subproblem; None for what thirty iterations of an interior point cost.
        """
        self.program = program
        self._limit = max_iterations
        self._workspace: osqp.OSQP | None = None
        self._adapted = False
        self._asked = 0.0, 0, False  # digits, iterations and polish, as the workspace has them
        self._graph = GraphRoute(program)

    @property
    def max_iterations(self) -> int:
        """Limit per subproblem."""
        if self._limit is None:
            self._limit = counted_iterations(self.program)
        return self._limit

    def begin(self) -> None:
        """Forget what the last solve has taught."""
        if self._workspace is not None and self._adapted:
            self._workspace.update_settings(rho=RHO)
            self._adapted = False

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve to ``accuracy``, polish, and measure."""
        nothing = QPAnswer(np.zeros(self.program.size), multipliers, self.name, 0, np.inf)
        packed = Packed.of(qp, EQUALITIES, INFINITY)
        if (packed.lower >= INFINITY).any() or (packed.upper <= -INFINITY).any():
            return nothing  # OSQP would print that the limits cross
        try:
            self._update(qp, packed)
            return self._refine(qp, packed, multipliers, max(FINER * accuracy, TIGHTEST), nothing)
        except osqp.OSQPException:  # a matrix so large that its rounding errors are not convex
            self._workspace = None
            return nothing

    def _update(self, qp: QP, packed: Packed) -> None:
        """Give OSQP the numbers of a scaled problem."""
        if self._workspace is None:
            rows = self.program.constraints.matrix(qp.jacobian)
            rows.data[:] = packed.entries
            self._workspace = osqp.OSQP()
            self._workspace.setup(
                P=qp.pattern.matrix(packed.hessian),
                q=packed.gradient,
                A=rows,
                l=packed.lower,
                u=packed.upper,
                verbose=False,
                rho=RHO,
                alpha=ALPHA,
                scaling=0,
                eps_rel=0.0,
                check_dualgap=False,
                polishing=False,
                adaptive_rho_interval=25,
                check_termination=EVERY,
            )
            self._adapted, self._asked = False, (0.0, 0, False)
            return
        self._workspace.update(q=packed.gradient, l=packed.lower, u=packed.upper, Px=packed.hessian, Ax=packed.entries)

    def _refine(self, qp: QP, packed: Packed, multipliers: Array, accuracy: float, best: QPAnswer) -> QPAnswer:
        """Ask for more digits until the answer is accurate or the iterations are used up."""
        assert self._workspace is not None
        digits, spent, equalities = DIGITS, 0, bool((qp.lower == qp.upper).any())
        self._workspace.warm_start(x=np.zeros(self.program.size), y=multipliers / packed.rows)
        while spent < self.max_iterations and digits >= FINEST:
            asked = digits, self.max_iterations - spent, equalities and digits < DIGITS
            if asked != self._asked:
                self._workspace.update_settings(eps_abs=asked[0], max_iter=asked[1], polishing=asked[2])
                self._asked = asked
            result = self._workspace.solve(raise_error=False)
            spent += int(result.info.iter)
            self._adapted = self._adapted or result.info.rho_updates > 0
            status = result.info.status_val
            if status == osqp.SolverStatus.OSQP_SIGINT:  # its own handler has taken the signal from Python
                raise KeyboardInterrupt
            if status not in (*SOLVED, UNFINISHED):
                return replace(best, iterations=spent, infeasible=best.infeasible or status in INFEASIBLE)
            step, dual = packed.columns * result.x, packed.rows * result.y
            if digits == DIGITS:
                held = step.copy(), dual.copy()
                error = self._graph.complete(qp, *held, accuracy)
                if error <= accuracy:
                    return QPAnswer(*held, self.name, spent, error)
            error = qp_error(qp, step, dual)
            if error < best.error:
                best = QPAnswer(step, dual, self.name, spent, error)
            if error <= accuracy or status == UNFINISHED:
                break
            digits *= 0.1
        return replace(best, iterations=spent)


def counted_iterations(program: CompiledProblem) -> int:
    """Iterations of OSQP that cost as many operations as :data:`WORTH` of an interior point.

    One of OSQP solves with the factor of the KKT matrix and passes over the vectors; one of an interior point
    factorises it anew and solves twice.
    """
    if not program.constraints.count:
        return EVERY
    tree = program.systems.kkt(np.ones(program.constraints.count, dtype=bool)).factorization.tree
    solving = 4.0 * tree.fill
    passing = 10.0 * (program.size + program.constraints.count)
    count = WORTH * (tree.flops + 2.0 * solving) / (solving + passing)
    return EVERY * int(np.ceil(count / EVERY))
