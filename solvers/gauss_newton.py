"""Gauss-Newton on the manifold: solve H d = -J'r, move by x Exp(d) (Bazzana III, eq. 2-4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.answers.solver import Run
from unifg.answers.status import Status
from unifg.program.linearization import Linearization
from unifg.solvers.damping import ROUNDING, norm
from unifg.solvers.least_squares import LeastSquares
from unifg.solvers.primal import Primal
from unifg.typing import Array

ARMIJO = 1e-4
SHORTEST = 1e-8


@dataclass(kw_only=True)
class GaussNewton(LeastSquares):
    """Unconstrained least squares with robust losses.

    Attributes:
        line_search: halve the step until the cost decreases; False takes full steps, as the papers do.
    """

    line_search: bool = True

    def search_step(self, run: Run, workspace: Primal, lin: Linearization) -> Array | None:
        """The full Gauss-Newton step."""
        none = np.zeros(0)
        return workspace.direction(lin.hessian, workspace.gradient(lin, none, none))

    def iterate(self, run: Run, workspace: Primal) -> Status | None:
        """Iterate to convergence."""
        none, run.lent = np.zeros(0), workspace
        while run.status is None:
            lin = run.lin
            gradient = workspace.gradient(lin, none, none)
            step = workspace.direction(lin.hessian, gradient)
            if step is None:
                return Status.SINGULAR
            slope = float(gradient @ step)
            length = 1.0
            reached = run.program.linearize(run.program.retract(lin.values, step))
            # Full steps are the rule: linearise at once, and only shortened steps are evaluated by themselves.
            trial = run.program.evaluate(reached.values, lin.weights) if lin.weights else reached
            while self.line_search and not (
                trial.finite and trial.cost <= (1.0 + ROUNDING) * lin.cost + ARMIJO * length * slope
            ):
                length *= 0.5
                if length < SHORTEST:
                    return Status.STALLED
                values, trial = workspace.trial(lin, length * step)
            if length < 1.0:
                reached = run.program.linearize(values)
            run.accept(reached, none, length * norm(step), length)
            if run.status is None and norm(step) < self.step_tolerance:
                return Status.STOP_RULE
        return None
