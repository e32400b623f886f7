"""KKT Gauss-Newton: constraints as factors with multiplier variables (ecg2o, section 4.2).

An equality h(x) = 0 becomes a factor of x and of its multipliers with error (h, lambda) and weight [[0, I], [I, 0]];
its contribution to the linear system is the block A and nothing else:

    [ H  A' ] [ d       ]     [ grad f + A' lambda ]
    [ A  0  ] [ dlambda ] = - [ h                  ]

The weight is indefinite, so the system is assembled as blocks, never through a square root. It is factorised with
a shift of every row in its own units, so that no order of elimination meets a vanishing pivot, and refined until the
shift is gone (:mod:`unifg.elimination.saddle`). H is that of Gauss-Newton, or of the Lagrangian where steps with the
first converge slowly (:mod:`unifg.solvers.globalize.slow_convergence`): second-order terms may be as large as H. A step
of the second that does not lower the merit is left for one of the first.

Inequalities are the paper's outlook: those of the active set are equalities of the system, which is solved again until
the linearised problem is (:mod:`unifg.solvers.active_set`).

The paper takes every step in full. By default a step has to lower the l1 merit f + price |h| (Nocedal and Wright,
chapter 18): the cost alone would reject steps that restore feasibility. A full step that is rejected is corrected once
for the curvature of the constraints before it is shortened; shortened steps damp the next ones. The price need not
exceed the largest multiplier of the linearised problem by much.

The outlook of the paper is Levenberg-Marquardt on this system: mu times the diagonal of H is added to H, and the
linearised constraints are to be met by a part 1 / (1 + mu). With a large mu the step is short in every direction and
one of descent for the l1 merit, whose gain ratio mu follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from unifg.elimination.saddle import NOTHING
from unifg.errors import BackendError
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import lagrangian_hessian, require_second
from unifg.problem.linearization import Linearization
from unifg.problem.systems import aim, fill
from unifg.solution.solve_state import SolveState
from unifg.solution.solver import Solver
from unifg.solution.status import Status
from unifg.solvers.active_set import ActiveSet
from unifg.solvers.augmented_objective import DIAGONAL_FLOOR
from unifg.solvers.globalize.damping import LARGEST, Damping, gain
from unifg.solvers.globalize.feasibility_restoration import leave, resume, settle
from unifg.solvers.globalize.line_search import search
from unifg.solvers.globalize.merit import OnePrice
from unifg.solvers.globalize.norms import largest, norm
from unifg.solvers.globalize.slow_convergence import second_derivatives_pay
from unifg.typing import Array

RESIDUAL = 1e-8  # relative, in the equilibrated system, of one that counts as solved
ENOUGH = 1e-12  # at which refinement ends
ROUNDING = 1e-13
FAILURES = 5  # attempts with growing damping at one step
FIRST_DAMPING, DAMPING_GROWTH, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-2, 10.0, 1e-9, 1e12
DAMPING_DECAY = 0.9  # faster forgetting cycles between overshooting and shortened steps
FIRST_SLACKNESS = 1e-4
FIRST_LEVENBERG = 1e-6
RETRY_GROWTH = 100.0
WORTH = 4.0  # iterations of Gauss-Newton that are left, from which on second derivatives pay
SHORT = 0.1  # share of a step with the Hessian of the Lagrangian below which one of Gauss-Newton is tried as well
PRICE = 2.0  # times the largest multiplier: the penalty of violation at most
ENTERING = 1e-3  # share of the tolerance by which a row is violated that enters the active set


@dataclass(kw_only=True)
class KKT(Solver):
    """Newton's method on the KKT conditions, with a Gauss-Newton Hessian and an active set of the inequalities.

    Attributes:
        full_steps: take every step in full, as the paper does; no merit function and no damping.
        second_order_correction: try to repair a full step that the merit function rejects.
        globalization: "line-search", or "levenberg-marquardt" on the KKT system, the paper's outlook.
        step_tolerance: the paper's stop rule, on the norm of the step in unknowns and multipliers together (1e-3
            there). A positive number switches it on; it does not grant CONVERGED.
    """

    rehearses = True
    scalar_costs = False

    full_steps: bool = False
    second_order_correction: bool = True
    globalization: Literal["line-search", "levenberg-marquardt"] = "line-search"
    step_tolerance: float = 0.0

    def __post_init__(self) -> None:
        """Refuse unknown words, and full steps that are to be damped."""
        super().__post_init__()
        if self.globalization not in ("line-search", "levenberg-marquardt"):
            words = "'line-search' or 'levenberg-marquardt'"
            raise BackendError(f"{self.name}: globalization must be {words}, found '{self.globalization}'")
        if self.full_steps and self.globalization == "levenberg-marquardt":
            raise BackendError(f"{self.name}: full_steps=True leaves nothing to Levenberg-Marquardt: choose one")

    def workspace(self, program: CompiledProblem) -> Newton:
        """Structure of the KKT matrix."""
        if program.fully_compiled and not self.full_steps:
            require_second(program)
        return Newton(program)

    def search_step(self, run: SolveState, workspace: Newton, lin: Linearization) -> Array | None:
        """The unknowns' part of the full step."""
        workspace.begin(run)
        found = workspace.step(lin, run.multipliers, SMALLEST_DAMPING, 0.0)
        return None if found is None else found[0]

    def iterate(self, run: SolveState, workspace: Newton) -> Status | None:
        """Iterate to convergence."""
        workspace.begin(run)
        if self.globalization == "levenberg-marquardt":
            return self._damped(run, workspace)
        merit = OnePrice(run.program)
        damping = slackness = 0.0
        failures, slow = 0, False
        while run.status is None:
            taken, slow = None, slow or (second_derivatives_pay(run, WORTH) and not self.full_steps)
            if slow and (found := workspace.step(run.lin, run.multipliers, 0.0, slackness, curved=True)) is not None:
                taken = self._search(run, workspace, merit, *found, hopeful=True)
            if doubtful := taken is None or taken[3] < SHORT:
                found = workspace.step(run.lin, run.multipliers, damping, slackness)
            if found is None and self.full_steps:
                return settle(run, Status.SINGULAR)
            # Damping tells of steps that were shortened: without it the full one will probably be taken.
            if doubtful and found is not None:
                taken = self._search(run, workspace, merit, *found, hopeful=damping == 0.0) or taken
            if (taken is None or slackness) and run.infeasible_stationary():
                if (ending := leave(run)) is not None:
                    return ending
                continue
            if taken is None:
                failures += 1
                if failures > FAILURES:
                    if (ending := _anew(run, workspace, found is None)) is not None:
                        return ending
                    merit, damping, slackness, failures = OnePrice(run.program), 0.0, 0.0, 0
                    continue
                damping = max(RETRY_GROWTH * damping, FIRST_DAMPING)
                if found is None:
                    slackness = max(RETRY_GROWTH * slackness, FIRST_SLACKNESS)
                continue
            after, step, change, length, corrected = taken
            run.accept(
                after,
                run.multipliers + change,
                norm(step),
                length,
                multiplier_step=norm(change),
                **({"damping": damping} if damping else {}),
                **({"correction": 1} if corrected else {}),
            )
            if run.status is None and np.hypot(norm(step), norm(change)) < self.step_tolerance:
                return Status.STOP_RULE
            failures = 0
            damping = _next_damping(damping, length)
            if damping > LARGEST_DAMPING:  # steps no longer move anything
                if (ending := _anew(run, workspace, singular=False)) is not None:
                    return ending
                merit, damping = OnePrice(run.program), 0.0
            slackness = 0.1 * slackness if slackness > SMALLEST_DAMPING else 0.0
        return None

    def _damped(self, run: SolveState, workspace: Newton, slow: bool = False) -> Status | None:
        """Levenberg and Marquardt's iteration; ``slow``: whether second derivatives have been found to pay."""
        merit, damping = OnePrice(run.program), Damping(FIRST_LEVENBERG)
        rejected, slackness = 0, 0.0
        while run.status is None:
            lin, slow = run.lin, slow or second_derivatives_pay(run, WORTH)
            less = damping.value / (1.0 + damping.value)
            curved = slow and rejected == 0
            found = workspace.step(lin, run.multipliers, damping.value, slackness, less, curved)
            reached = None
            if found is not None:
                linear = run.program.constraints.times(lin.constraint_jacobian, found[0])
                predicted = merit.predicted(lin, found[0], linear)
                here = merit.value(lin)
                slack = ROUNDING * max(1.0, abs(here))
                values = run.program.retract(lin.values, found[0])
                trial = run.program.evaluate(values, lin.weights)
                actual = here - merit.value(trial)
                gained = gain(actual, predicted, slack) if np.isfinite(predicted) and trial.finite else None
                if gained is not None:
                    damping.accept(min(gained, 1.0))
                    reached = run.program.linearize(values)
            if found is None or reached is None:
                if found is None:
                    slackness = max(RETRY_GROWTH * slackness, FIRST_SLACKNESS)
                damping.reject()
                rejected += 1
                if damping.value > LARGEST:
                    ending = _anew(run, workspace, found is None)
                    return self._damped(run, workspace, slow) if ending is None else ending
                if run.infeasible_stationary() and (ending := leave(run)) is not None:
                    return ending
                continue
            if slackness and predicted <= slack:  # rows that contradict each other, met by halves as well as may be
                ending = _anew(run, workspace, singular=False)
                return self._damped(run, workspace, slow) if ending is None else ending
            step, change = found
            details = {"damping": damping.value, "rejected": rejected, "multiplier_step": norm(change)}
            run.accept(reached, run.multipliers + change, norm(step), 1.0, **details)
            if run.status is None and np.hypot(norm(step), norm(change)) < self.step_tolerance:
                return Status.STOP_RULE
            if run.status is None and slackness and run.infeasible_stationary() and (ending := leave(run)) is not None:
                return ending
            rejected, slackness = 0, 0.1 * slackness if slackness > SMALLEST_DAMPING else 0.0
        return None

    def _search(
        self, run: SolveState, workspace: Newton, merit: OnePrice, step: Array, change: Array, hopeful: bool
    ) -> tuple[Linearization, Array, Array, float, bool] | None:
        """New linearisation, step and change of multipliers as taken, length, whether corrected; None for no step."""
        program, lin = run.program, run.lin
        if self.full_steps:
            return program.linearize(program.retract(lin.values, step)), step, change, 1.0, False
        linear = program.constraints.times(lin.constraint_jacobian, step)
        slope = merit.slope(lin, step, linear, PRICE * largest(run.multipliers + change))
        here = merit.value(lin)
        slack = ROUNDING * max(1.0, abs(here)) + merit.rounding(lin)
        if not slope <= slack:
            return None

        def correct(bend: Array) -> tuple[Array, Array] | None:
            return workspace.resolve(lin, run.multipliers, bend)

        wanted = correct if self.second_order_correction else None
        found = search(lin, step, merit, here, slope, slack, linear, wanted, eager=hopeful)
        if found is None:
            return None
        change = found.length * change if found.dual is None else found.dual
        return found.reached, found.step, change, found.length, found.dual is not None


class Newton:
    """The KKT system of one prepared graph."""

    def __init__(self, program: CompiledProblem) -> None:
        """Analyse the KKT matrix."""
        self.program = program
        self._structure(program)

    def begin(self, run: SolveState) -> None:
        """Look at the limits of this solve, which may be data, and begin with its multipliers."""
        program, inequalities = self.program, self.program.inequalities
        if not np.array_equal(program.equality | inequalities, self.system.held):
            self._structure(program)
        choice = bool(inequalities.any())
        self.active = ActiveSet(program, choice, run.multipliers, ENTERING * run.tolerances.violation)
        self._near = NOTHING  # equal solves take equal steps

    def step(
        self,
        lin: Linearization,
        multipliers: Array,
        damping: float,
        slackness: float,
        less: float = 0.0,
        curved: bool = False,
    ) -> tuple[Array, Array] | None:
        """Solve for the step.

        Args:
            lin: where.
            multipliers: (M,) there.
            damping: added to the diagonal of H, relative to it; turns the step towards descent.
            slackness: subtracted from the diagonal of the multipliers' block, relative to the largest A A' / H; lets
                linearised constraints that contradict each other be met by halves.
            less: part of the violation that the linearised constraints may keep.
            curved: whether H is the Hessian of the Lagrangian.

        Returns:
            (n,) tangent step and (M,) change of the multipliers; None when the system is singular, or no active set
            was found.
        """
        n = self.program.size
        hessian = lagrangian_hessian(self.program, lin, multipliers) if curved else lin.hessian
        fill(self.system.arrays, hessian, lin.constraint_jacobian, self._data)
        if damping or slackness:
            diagonal = self.system.pattern.diagonal
            curvatures = self._data[diagonal[:n]]
            curvature = float(curvatures.max(initial=0.0)) or 1.0
            pull = (largest(lin.constraint_jacobian) or 1.0) ** 2 / curvature
            self._data[diagonal[:n]] += damping * np.maximum(curvatures, DIAGONAL_FLOOR * curvature)
            self._data[diagonal[n:]] -= slackness * pull
        if not self.active.choice:
            return self._solved(lin, multipliers, less)
        for _ in self.active.attempts():
            found = self._solved(lin, multipliers, less, convex=curved)
            if found is None:
                self.active.fail()
                continue
            reached = lin.constraints + self.program.constraints.times(lin.constraint_jacobian, found[0])
            if self.active.settled(reached, multipliers + found[1]):
                return found
        return None

    def _solved(
        self, lin: Linearization, multipliers: Array, less: float, convex: bool = False
    ) -> tuple[Array, Array] | None:
        """The step for the present active set; None where the system is singular, or not ``convex`` as it has to be."""
        n, rows, data = self.program.size, self.system.arrays.rows, self._data
        if self.active.choice and (out := ~self.active.held[rows]).any():
            data = self.system.without(data, np.concatenate([np.zeros(n, dtype=bool), out]))
        if not self.system.saddle.factor(data, self._near):
            return None
        self._near = self.system.saddle.scale
        if convex and self.system.factorization.inertia != (n, len(rows), 0):
            return None
        return self.resolve(lin, multipliers, less * self.active.missing(lin.constraints))

    def resolve(self, lin: Linearization, multipliers: Array, bend: Array) -> tuple[Array, Array] | None:
        """Solve with the last factorisation, the constraints moved by ``bend`` (M,)."""
        program, n, rows, held = self.program, self.program.size, self.system.arrays.rows, self.active.held
        right = np.empty(n + len(rows))
        aim(
            program.arrays,
            program.columns.free,
            rows,
            lin.gradient,
            lin.constraints,
            lin.constraint_jacobian,
            np.where(held, multipliers, 0.0),
            bend,
            right,
        )
        if self.active.choice:
            right[n:] = np.where(held, self.active.missing(lin.constraints) - bend, 0.0)[rows]
        found, error = self.system.saddle.solve(right, ENOUGH)
        if not error <= RESIDUAL:
            return None
        change = np.where(held, 0.0, -multipliers)
        change[rows] += found[n:]
        return found[:n], change

    def _structure(self, program: CompiledProblem) -> None:
        self.system = program.systems.kkt(program.equality | program.inequalities)
        self._data, self._near = np.zeros(self.system.pattern.nnz), NOTHING


def _anew(run: SolveState, workspace: Newton, singular: bool) -> Status | None:
    """Begin anew where feasibility restoration ends, or return the reason to stop."""
    ending = resume(run, Status.SINGULAR if singular else Status.STALLED)
    if ending is None:
        workspace.begin(run)
    return ending


def _next_damping(damping: float, length: float) -> float:
    """A shortened step means curvature that H does not know: damp, and forget it again."""
    if length < 1.0:
        return max(DAMPING_GROWTH * damping, FIRST_DAMPING)
    return DAMPING_DECAY * damping if damping > SMALLEST_DAMPING else 0.0
