"""Levenberg-Marquardt: Gauss-Newton damped by the gain ratio; robust far from the solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.answers.solver import Run
from unifg.answers.status import Status
from unifg.program.linearization import Linearization
from unifg.solvers.damping import Damping, damped_step, norm
from unifg.solvers.least_squares import LeastSquares
from unifg.solvers.model import model_step
from unifg.solvers.primal import Primal
from unifg.typing import Array


@dataclass(kw_only=True)
class LevenbergMarquardt(LeastSquares):
    """Unconstrained least squares with robust losses.

    Attributes:
        damping: initial damping, relative to the diagonal of the Hessian.
    """

    damping: float = 1e-4

    def search_step(self, run: Run, workspace: Primal, lin: Linearization) -> Array | None:
        """The step at the initial damping."""
        found = model_step(workspace, lin, np.zeros(0), np.zeros(0), self.damping)
        return None if found is None else found[0]

    def iterate(self, run: Run, workspace: Primal) -> Status | None:
        """Iterate to convergence."""
        none, run.lent = np.zeros(0), workspace
        damping = Damping(self.damping)
        while run.status is None:
            used, workspace.hopeful, workspace.reached = damping.value, True, None
            taken = damped_step(workspace, run.lin, none, none, damping)
            if taken is None:
                return Status.STALLED
            values, step, rejected = taken
            # Rejected steps are the exception: the first trial is linearised at once, later ones are evaluated first.
            lin = workspace.reached if rejected == 0 else None
            lin = run.program.linearize(values) if lin is None else lin
            run.accept(lin, none, norm(step), 1.0, damping=used, rejected=rejected)
            if run.status is None and norm(step) < self.step_tolerance:
                return Status.STOP_RULE
        return None
