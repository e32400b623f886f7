"""Unconstrained least squares: Gauss-Newton with a line search, with damping, and in a trust region.

Gauss-Newton solves H d = -J'r and moves by x Exp(d) (Bazzana III, eq. 2-4). Levenberg-Marquardt damps it by the gain
ratio. Powell's dog-leg walks from the Cauchy point to the Gauss-Newton point as far as the region reaches: one
factorisation per linearisation, for when a step is rejected only the radius changes (Nocedal and Wright, section 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from unifg.codegen.inner import inner
from unifg.errors import BackendError, require_positive
from unifg.factors.steps import VECTOR, parts_of
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.solve_state import SolveState
from unifg.solution.solver import Solver
from unifg.solution.status import Status
from unifg.solvers.augmented_objective import Primal
from unifg.solvers.augmented_step import damped_step, model_step
from unifg.solvers.globalize.damping import Damping, gain
from unifg.solvers.globalize.line_search import search
from unifg.solvers.globalize.merit import Merit
from unifg.solvers.globalize.norms import norm
from unifg.typing import Array

MAP = 1e-5**0.5  # the relative offset is the root of the share of the cost that a step promises to remove
ROUNDING = 1e-14
SHORTEST = 1e-8  # length of a Gauss-Newton step
SMALLEST, POOR, GOOD = 1e-14, 0.25, 0.75  # radius of a trust region; gains at which it shrinks and grows


@dataclass(kw_only=True)
class LeastSquares(Solver):
    """Unconstrained sums of squares with robust losses.

    Attributes:
        tolerance: for the KKT test, the relative offset of the residuals (:mod:`unifg.solution.relative_offset`). "map"
            stands for `MAP`, where another step would lower the cost by less than 1e-5 of it: what GTSAM stops at, and
            enough for a map; the default goes on until the optimum is reached to all digits that matter to anybody.
        step_tolerance: optional stop rule on the norm of the step; it does not grant CONVERGED.
    """

    rehearses = True
    constraints = "none"
    scalar_costs = False

    tolerance: float | Literal["map"] = 1e-6  # type: ignore[assignment]  # a number as soon as it has been made
    step_tolerance: float = 0.0

    def __post_init__(self) -> None:
        """Let names stand for numbers.

        Raises:
            BackendError: for another name, or options no solve could honour.
        """
        if isinstance(self.tolerance, str):
            if self.tolerance != "map":
                raise BackendError(f"{self.name}: tolerance is a number or 'map', found {self.tolerance!r}")
            self.tolerance = MAP
        super().__post_init__()

    def workspace(self, program: CompiledProblem) -> Primal:
        """The factorisation of the normal equations."""
        return Primal(program)


@dataclass(kw_only=True)
class GaussNewton(LeastSquares):
    """Unconstrained least squares with robust losses.

    Attributes:
        line_search: halve the step until the cost decreases; False takes full steps, as the papers do.
    """

    line_search: bool = True

    def search_step(self, run: SolveState, workspace: Primal, lin: Linearization) -> Array | None:
        """The full Gauss-Newton step."""
        none = np.zeros(0)
        return workspace.direction(lin.hessian, workspace.gradient(lin, none, none))

    def iterate(self, run: SolveState, workspace: Primal) -> Status | None:
        """Iterate to convergence."""
        none, run.lent, merit = np.zeros(0), workspace, Merit(run.program)
        while run.status is None:
            lin = run.lin
            gradient = workspace.gradient(lin, none, none)
            step = workspace.direction(lin.hessian, gradient)
            if step is None:
                return Status.SINGULAR
            if not self.line_search:
                run.accept(run.program.linearize(run.program.retract(lin.values, step)), none, norm(step), 1.0)
            else:
                slope, slack = inner(gradient, step), ROUNDING * lin.cost
                found = search(lin, step, merit, lin.cost, slope, slack, eager=True, shortest=SHORTEST)
                if found is None:
                    return Status.STALLED
                run.accept(found.reached, none, found.length * norm(step), found.length)
            if run.status is None and norm(step) < self.step_tolerance:
                return Status.STOP_RULE
        return None


@dataclass(kw_only=True)
class LevenbergMarquardt(LeastSquares):
    """Unconstrained least squares with robust losses.

    Attributes:
        damping: initial damping, relative to the diagonal of the Hessian. Along a chain of poses errors add up, so the
            curvature of its long bends is 1e-8 of the diagonal and less: more damping than that takes many steps to
            straighten them. Where more is needed, a few rejections bring it, each growing faster than the last. So does
            a first step beyond the spread of the guess whose model was not faithful: squares that do not grow without
            end would let unknowns go where nothing is seen of them, and they would stay.
    """

    damping: float = 1e-8

    def workspace(self, program: CompiledProblem) -> Primal:
        """As of all; steps that rounding swallows, of which the first may be one in a loop, ask for multipliers."""
        primal, none = super().workspace(program), np.zeros(0)
        primal.next_multipliers(none, none, none)
        return primal

    def search_step(self, run: SolveState, workspace: Primal, lin: Linearization) -> Array | None:
        """The step at the initial damping."""
        workspace.remember(lin, anew=True)
        found = model_step(workspace, lin, np.zeros(0), np.zeros(0), self.damping)
        return None if found is None else found[0]

    def iterate(self, run: SolveState, workspace: Primal) -> Status | None:
        """Iterate to convergence."""
        none, run.lent = np.zeros(0), workspace
        damping, reach = Damping(self.damping), _sizes(run.program, run.lin)
        workspace.remember(run.lin, anew=True)
        while run.status is None:
            used, workspace.hopeful, workspace.reached = damping.value, True, None
            taken = damped_step(workspace, run.lin, none, none, damping, reach=reach)
            if taken is None:
                return Status.STALLED
            values, step, rejected = taken
            # Rejected steps are the exception: the first trial is linearised at once, later ones are evaluated first.
            lin, reach = workspace.linearized(values), none
            workspace.remember(lin)
            run.accept(lin, none, norm(step), 1.0, damping=used, rejected=rejected)
            if run.status is None and norm(step) < self.step_tolerance:
                return Status.STOP_RULE
        return None


def _sizes(program: CompiledProblem, lin: Linearization) -> Array:
    """(n,) how far apart the vectors of a family are along each coordinate, or the number of a single one.

    Infinite where that is zero, and for poses: along a chain errors add up, and a bend may have to go any way.
    """
    sizes = np.full(program.columns.width, np.inf)
    for family in program.families:
        begin, dim = program.columns.offsets[family], family.manifold.dim
        for part, _ in parts_of(family.manifold):
            for axis in range(part.dim if part.kind == VECTOR and part.turn < 0 else 0):
                column = begin + part.column + axis
                numbers = lin.values[family][:, part.start + axis]
                size = np.ptp(numbers) if family.count > 1 else np.abs(numbers[0])
                sizes[column : begin + dim * family.count : dim] = size or np.inf
    return sizes[program.columns.free]


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
        require_positive(self.name, BackendError, finite=False, radius=self.radius)

    def search_step(self, run: SolveState, workspace: Primal, lin: Linearization) -> Array | None:
        """The step within the first radius."""
        found = Path.at(workspace, lin)
        return None if found is None else found.step(self.radius)

    def iterate(self, run: SolveState, workspace: Primal) -> Status | None:
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
                gained = gain(lin.cost - trial.cost, predicted, ROUNDING * lin.cost) if trial.finite else None
                if gained is None or gained < POOR:
                    radius = 0.25 * norm(step)
                elif gained > GOOD:
                    radius = max(radius, 3.0 * norm(step))
                if gained is not None:
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

    program: CompiledProblem
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
        curvature = inner(downhill, program.normal.times(lin.hessian, downhill))
        return cls(program, lin.hessian, gradient, newton, -gradient / max(curvature, 1e-300))

    def step(self, radius: float) -> Array:
        """The point of the path at ``radius``, or its end."""
        if norm(self.newton) <= radius:
            return self.newton
        if norm(self.cauchy) >= radius:
            return self.cauchy * (radius / norm(self.cauchy))
        size = norm(self.newton)  # whose square may overflow
        begin, leg = self.cauchy / size, (self.newton - self.cauchy) / size
        a, b = inner(leg, leg), inner(begin, leg)
        c = norm(begin) ** 2 - (radius / size) ** 2
        fraction = -c / (b + np.sqrt(b * b - a * c))  # the positive root, without cancellation
        step: Array = size * (begin + fraction * leg)
        return step

    def decrease(self, step: Array) -> float:
        """Decrease predicted by the quadratic model."""
        curved = self.program.normal.times(self.hessian, step)
        return -inner(step, self.gradient + 0.5 * curved)
