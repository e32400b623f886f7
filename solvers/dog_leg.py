"""Powell's dog-leg: Gauss-Newton inside a trust region, steepest descent where the region is small.

One factorisation per linearisation: when a step is rejected only the radius changes, and the path from the Cauchy
point to the Gauss-Newton point is walked less far (Nocedal and Wright, section 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.answers.solver import Run
from unifg.answers.status import Status
from unifg.errors import BackendError
from unifg.program.linearization import Linearization
from unifg.program.program import Program
from unifg.solvers.damping import norm
from unifg.solvers.least_squares import LeastSquares
from unifg.solvers.primal import Primal
from unifg.typing import Array

ROUNDING = 1e-14
SMALLEST = 1e-14
ACCEPT, POOR, GOOD = 1e-4, 0.25, 0.75


@dataclass(kw_only=True)
class DogLeg(LeastSquares):
    """Unconstrained least squares with robust losses, in a trust region.

    Attributes:
        radius: of the first trust region, in the norm of the tangent step.
    """

    radius: float = 10.0

    def __post_init__(self) -> None:
        """Refuse a radius that is not positive."""
        super().__post_init__()
        if not self.radius > 0.0:
            raise BackendError(f"{self.name}: radius must be positive, found {self.radius}")

    def search_step(self, run: Run, workspace: Primal, lin: Linearization) -> Array | None:
        """The step within the first radius."""
        found = Path.at(workspace, lin)
        return None if found is None else found.step(self.radius)

    def iterate(self, run: Run, workspace: Primal) -> Status | None:
        """Iterate to convergence."""
        radius, run.lent = self.radius, workspace
        while run.status is None:
            lin = run.lin
            path = Path.at(workspace, lin)
            if path is None:
                return Status.SINGULAR
            rejected = 0
            while True:
                step = path.step(radius)
                predicted = path.decrease(step)
                values, trial = workspace.trial(lin, step)
                actual = lin.cost - trial.cost
                slack = ROUNDING * lin.cost
                gain = actual / predicted if predicted > slack else 1.0
                good = trial.finite and actual >= ACCEPT * predicted - slack
                if not good or gain < POOR:
                    radius = 0.25 * norm(step)
                elif gain > GOOD:
                    radius = max(radius, 3.0 * norm(step))
                if good:
                    break
                rejected += 1
                if radius < SMALLEST:
                    return Status.STALLED
            run.accept(run.program.linearize(values), np.zeros(0), norm(step), 1.0, radius=radius, rejected=rejected)
            if run.status is None and norm(step) < self.step_tolerance:
                return Status.STOP_RULE
        return None


@dataclass
class Path:
    """The dog-leg path of one linearisation.

    Attributes:
        program: the compiled graph.
        hessian: entries of the Gauss-Newton Hessian.
        gradient: (n,) of the objective.
        newton: (n,) Gauss-Newton step.
        cauchy: (n,) minimiser of the model along the negative gradient.
    """

    program: Program
    hessian: Array
    gradient: Array
    newton: Array
    cauchy: Array

    @classmethod
    def at(cls, primal: Primal, lin: Linearization) -> Path | None:
        """Both ends of the path; None when the Hessian cannot be factorised."""
        program, none = primal.program, np.zeros(0)
        gradient = primal.gradient(lin, none, none)
        newton = primal.direction(lin.hessian, gradient)
        if newton is None:
            return None
        downhill = gradient / (norm(gradient) or 1.0)
        curvature = float((downhill * program.normal.times(lin.hessian, downhill)).sum())
        return cls(program, lin.hessian, gradient, newton, -gradient / max(curvature, 1e-300))

    def step(self, radius: float) -> Array:
        """The point of the path at ``radius``, or its end."""
        if norm(self.newton) <= radius:
            return self.newton
        if norm(self.cauchy) >= radius:
            return self.cauchy * (radius / norm(self.cauchy))
        size = norm(self.newton)  # whose square may overflow
        begin, leg = self.cauchy / size, (self.newton - self.cauchy) / size
        a, b = float((leg * leg).sum()), float((begin * leg).sum())
        c = norm(begin) ** 2 - (radius / size) ** 2
        fraction = -c / (b + np.sqrt(b * b - a * c))  # the positive root, without cancellation
        step: Array = size * (begin + fraction * leg)
        return step

    def decrease(self, step: Array) -> float:
        """What the quadratic model promises."""
        curved = self.program.normal.times(self.hessian, step)
        return -float((step * (self.gradient + 0.5 * curved)).sum())
