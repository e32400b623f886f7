"""Constraints as costs with a growing weight: the baseline (ecg2o, section 3.3).

Every constraint becomes the cost rho/2 |v|^2 of its violation v, which is zero on the permitted side of an inequality.
Each weight rho of a schedule has its own minimum, where the next one starts; there rho v is the estimate of the
multipliers, and the violation left is about lambda / rho. A small violation takes a large weight, which makes the
systems ill-conditioned: `AugmentedLagrangian` needs neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.errors import BackendError, require_positive
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.solve_state import SolveState
from unifg.solution.solver import Solver
from unifg.solution.status import Status
from unifg.solvers.augmented_objective import Primal
from unifg.solvers.augmented_step import damped_step, model_step
from unifg.solvers.globalize.damping import Damping
from unifg.solvers.globalize.feasibility_restoration import resume, settle
from unifg.solvers.globalize.norms import norm
from unifg.typing import Array

ROUNDING = 1e-15  # relative decrease of the objective that is noise


@dataclass(kw_only=True)
class Penalty(Solver):
    """Equalities and inequalities as quadratic penalties with a schedule of growing weights.

    The multipliers returned are the estimates rho times violation; those of the guess are not used, and the prices of
    soft constraints hold their slacks. When the last weight leaves the problem's own KKT conditions unmet, the status
    is STOP_RULE.

    Attributes:
        max_iterations: steps over all weights.
        penalty: first weight rho.
        penalty_growth: factor from one weight to the next.
        largest_penalty: the last weight.
        inner_iterations: steps before the next weight, converged or not.
        damping: initial Levenberg-Marquardt damping of each weight.
    """

    rehearses = True

    scalar_costs = False
    soft = True

    max_iterations: int = 300
    penalty: float = 1.0
    penalty_growth: float = 10.0
    largest_penalty: float = 1e10
    inner_iterations: int = 20
    damping: float = 1e-6

    def __post_init__(self) -> None:
        """Refuse schedules that do not grow, or make no step."""
        super().__post_init__()
        require_positive(self.name, BackendError, penalty=self.penalty, inner_iterations=self.inner_iterations)
        if not self.penalty_growth > 1.0:
            raise BackendError(f"{self.name}: penalty_growth must be above 1, found {self.penalty_growth}")

    def workspace(self, program: CompiledProblem) -> Primal:
        """The factorisation of the normal equations."""
        return Primal(program)

    def search_step(self, run: SolveState, workspace: Primal, lin: Linearization) -> Array | None:
        """A step at the first weight and the initial damping."""
        held = workspace.prices(lin)
        found = model_step(workspace, lin, held, np.full(len(held), self.penalty), self.damping)
        return None if found is None else found[0]

    def iterate(self, run: SolveState, workspace: Primal) -> Status | None:
        """Minimise for one weight after the other."""
        held = workspace.prices(run.lin)
        rho = self.penalty
        last = max(self.largest_penalty, rho)
        while True:
            stalled = self._minimize(run, workspace, held, rho)
            if run.status is not None:
                return None
            if not self._violated(run):  # a heavier weight would not help
                if stalled:
                    return Status.STALLED
                continue
            if rho >= last:
                if not stalled:
                    return settle(run, Status.STOP_RULE)
                if (ending := resume(run, Status.STALLED)) is not None:
                    return ending
                held, rho = workspace.prices(run.lin), self.penalty
                continue
            rho = min(rho * self.penalty_growth, last)

    def _minimize(self, run: SolveState, primal: Primal, held: Array, rho: float) -> bool:
        """Minimise for one weight; returns whether no step helped any more."""
        penalty = np.full(len(held), rho)
        damping = Damping(self.damping)
        for _ in range(self.inner_iterations):
            gradient = float(np.abs(primal.gradient(run.lin, held, penalty)).max(initial=0.0))
            if self._violated(run) and gradient <= max(min(1.0, 1.0 / rho), run.enough):
                return False
            taken = damped_step(primal, run.lin, held, penalty, damping)
            if taken is None:
                return True
            values, step, rejected = taken
            before = primal.merit(run.lin, held, penalty)
            # rho times the violation of the new iterate would be mostly rounding errors once rho is large; the linear
            # model's balance the gradient of the cost to the accuracy of the linear solve.
            estimate = primal.expected_multipliers(run.lin, step, held, penalty, run.lin.constraints)
            lin = run.program.linearize(values)
            run.accept(lin, estimate, norm(step), 1.0, penalty=rho, damping=damping.value, rejected=rejected)
            if run.status is not None:
                return False
            gained = before - primal.merit(lin, held, penalty)
            # Beside a gross cost of least squares, the progress of all others is rounding.
            if not run.program.least_squares and gained <= ROUNDING * max(1.0, abs(before)):
                return True
        return False

    def _violated(self, run: SolveState) -> bool:
        """Test whether the constraints as they are ask for a heavier weight."""
        return not run.optimality.feasible(run.tolerances)
