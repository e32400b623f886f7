"""Augmented Lagrangian inside iterative least squares (Bazzana VI, ecg2o 4.1).

The primal step is a damped Newton step on the Powell-Hestenes-Rockafellar objective, the dual step
lambda <- lambda+. Violations are judged after the step. By default tolerances tighten as in the bound-constrained
Lagrangian method (Conn, Gould, Toint 1991; Nocedal and Wright, algorithm 17.4); ``schedule="bazzana"`` is the
paper's own loop: one primal step, one dual step, constant penalty; ``"bazzana-damped"`` damps its primal steps, as the
library behind the paper does when asked to. The papers' costs carry no 1/2: their rho and
lambda are twice ours.

Second derivatives are those of the Lagrangian with the multipliers that the last step's linear model predicts,
lambda + rho (g + A d). At the point reached the first-order lambda + rho g may be far larger, where g is curved, and a
Hessian with these converges slowly. The predicted ones are also free of what rho makes of the rounding of g, which
far from the origin exceeds any tolerance; so of the two estimates the one that balances the gradient better is the
next multiplier. Steps along curved constraints are corrected to second order (:func:`damped_step`), so that they may
be long where rho is large.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import BackendError, require_positive
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.multipliers import size_of_costs
from unifg.solution.solve_state import SolveState
from unifg.solution.solver import Solver
from unifg.solution.status import Status
from unifg.solvers.augmented_objective import Primal
from unifg.solvers.augmented_step import STRAIGHT, damped_step, model_step
from unifg.solvers.globalize.damping import Damping
from unifg.solvers.globalize.feasibility_restoration import leave, resume, settle
from unifg.solvers.globalize.norms import geometric_mean, largest, norm
from unifg.typing import Array, IntArray

logger = logging.getLogger("unifg")

LARGEST_PENALTY = 1e10
LARGEST_EASY = 1e6  # up to here rho grows after subproblems of one step
COLD_PENALTY = 10.0  # Birgin and Martinez
STEEP = 5.0  # times the slopes of scalar costs, along which a curved one may fall further
FALL = 0.25  # of the change of multipliers over rho, between outer iterations; else rho grows
FALLING = 0.9  # of the violation, between outer iterations: progress where rho cannot grow
STEADY = 20  # steps of the literal loop without a lower violation, before a warning
KEPT = 1e-9  # violation of constraints that hold but for rounding, whatever the tolerance
PATIENCE = 3  # outer iterations in which it did not fall, before another way is looked for
WARM_PENALTY = 100.0
UNSEEN = 1e-11  # of the largest coordinate: steps as short as this are rounding, unless the gradient falls
LONGEST, SHORTEST = 2.0, 0.5  # rows of the constraint Jacobian whose length lies between are left as stated
GROWN = 0.5  # of a row's scale, when its gradient has become longer
LARGEST_SCALE = 1e4  # a row that hardly moves at the start says little about its scale


@dataclass(kw_only=True)
class AugmentedLagrangian(Solver):
    """Equalities and inequalities by multipliers and penalties.

    Attributes:
        max_iterations: primal steps over all outer iterations.
        penalty: initial rho; None takes that of the guess, if it comes from a solve, and else balances cost and
            violation at the start (Birgin and Martinez 2014).
        penalty_growth: factor on rho when the violation did not fall enough.
        scaling: weigh the penalty of each constraint by the inverse square of its gradient's length at the start, so
            that one rho suits metres and kilometres; not in Bazzana's schedules.
        schedule: "bcl", "bazzana" or "bazzana-damped", the same with Levenberg-Marquardt steps.
        step_tolerance, violation_tolerance: Bazzana's stop rule (section VII-D, 1e-4 there): the step's norm
            and the largest violation. A positive step_tolerance switches it on; it does not grant CONVERGED.
        inner_iterations: primal steps before the next dual step, converged or not.
        damping: initial Levenberg-Marquardt damping of the primal step.
        hessian: "exact" (of the Lagrangian; less of its second derivatives, down to Gauss-Newton's, where it is not
            convex) or "gauss-newton". Bazzana's schedules and graphs without constraints have Gauss-Newton's.
    """

    rehearses = True

    max_iterations: int = 300
    penalty: float | None = None
    penalty_growth: float = 10.0
    scaling: bool = True
    schedule: Literal["bcl", "bazzana", "bazzana-damped"] = "bcl"
    step_tolerance: float = 0.0
    violation_tolerance: float = 1e-4
    inner_iterations: int = 20
    damping: float = 1e-6
    hessian: Literal["exact", "gauss-newton"] = "exact"

    def __post_init__(self) -> None:
        """Refuse unknown words, penalties that are not positive or do not grow, and no inner iterations."""
        super().__post_init__()
        if self.schedule not in ("bcl", "bazzana", "bazzana-damped"):
            words = "'bcl', 'bazzana' or 'bazzana-damped'"
            raise BackendError(f"{self.name}: schedule must be {words}, found '{self.schedule}'")
        if self.hessian not in ("exact", "gauss-newton"):
            raise BackendError(f"{self.name}: hessian must be 'exact' or 'gauss-newton', found '{self.hessian}'")
        penalty = 1.0 if self.penalty is None else self.penalty
        require_positive(self.name, BackendError, penalty=penalty, inner_iterations=self.inner_iterations)
        if not self.penalty_growth > 1.0:
            raise BackendError(f"{self.name}: penalty_growth must be above 1, found {self.penalty_growth}")

    def workspace(self, program: CompiledProblem) -> Primal:
        """The factorisation of the primal step."""
        return Primal(program)

    def search_step(self, run: SolveState, workspace: Primal, lin: Linearization) -> Array | None:
        """The primal step at the initial damping, with the penalty that suits the present iterate."""
        rho, weights = self._first_penalties(run, workspace)
        scalars = run.program.scalar_part(lin.values)
        found = model_step(workspace, lin, run.multipliers, rho * weights, self.damping, scalars=scalars)
        return None if found is None else found[0]

    def iterate(self, run: SolveState, workspace: Primal) -> Status | None:
        """Alternate primal and dual steps."""
        rho, weights = self._first_penalties(run, workspace)
        if not run.multipliers.any():
            run.multipliers = workspace.prices(run.lin)
        alternate = self._tightening if self.schedule == "bcl" else self._literal
        return alternate(run, workspace, rho, weights)

    def _literal(self, run: SolveState, primal: Primal, rho: float, weights: Array) -> Status | None:
        """One Gauss-Newton step, one dual step, constant rho.

        With Levenberg and Marquardt's damping a primal step has to lower the augmented objective. Where the violation
        does not fall for `STEADY` steps, a warning names the penalty.
        """
        run.penalties = penalty = rho * weights
        damping, damped = Damping(self.damping), self.schedule == "bazzana-damped"
        lowest, since = np.inf, 0  # violation, and steps without a lower one
        while run.status is None:
            violation = run.optimality.violation
            kept = max(run.tolerances.violation, KEPT)  # up to it there is nothing to be fallen below again
            since = 0 if violation <= max(FALLING * lowest, kept) or 0.0 <= lowest <= kept else since + 1
            lowest = violation if since == 0 else lowest
            if since == STEADY:
                logger.warning(
                    "%s: in %d steps with the constant penalty %g the violation, at last of '%s' (factor %d), has not "
                    "fallen below %.2g; %s may do, and schedule='bcl' chooses its own penalties", self.name, STEADY,
                    rho, *run.program.row_name(run.optimality.worst_row), lowest,
                    "a larger penalty" if damped else "schedule='bazzana-damped'",
                )  # fmt: skip
                lowest = -np.inf  # once is enough
            lin, multipliers, rejected = run.lin, run.multipliers, 0
            if not damped:
                curvature = primal.curvature(lin, multipliers, penalty)
                found = primal.direction(curvature, primal.gradient(lin, multipliers, penalty))
                if found is None:
                    return Status.SINGULAR
                values, step = run.program.retract(lin.values, found), found
            elif (taken := damped_step(primal, lin, multipliers, penalty, damping)) is not None:
                values, step, rejected = taken
            else:  # at a minimum to all digits: the dual step goes on
                values, step, damping = lin.values, np.zeros(run.program.size), Damping(self.damping)
            after = run.program.linearize(values)
            updated = primal.next_multipliers(after.constraints, multipliers, penalty)
            if values is lin.values and np.array_equal(updated, multipliers):
                return settle(run, Status.STALLED)
            details = {"damping": damping.value, "rejected": rejected} if damped else {}
            run.accept(after, updated, norm(step), 1.0, penalty=rho, **details)
            if run.status is None and self._stop_rule(run, norm(step)):
                return Status.STOP_RULE
        return None

    def _tightening(self, run: SolveState, primal: Primal, rho: float, weights: Array) -> Status | None:
        """Solve each subproblem only as accurately as its multipliers deserve."""
        multipliers = expected = run.multipliers
        damping = Damping(self.damping)
        scale = np.sqrt(weights)
        unit = self._scale(primal, run.lin)
        # Goals are for scaled violations, the KKT test and the last resort for those as stated.
        heaviest = _stiffness(run, weights) * LARGEST_PENALTY / min(1.0, float(weights.min(initial=1.0)))
        least = 0.1 * run.tolerances.violation * min(1.0, float(scale.min(initial=1.0)))
        gradient_goal, violation_goal = self._goals(run, primal, rho, multipliers, rho * weights)
        exact = self.hessian == "exact" and (len(weights) > 0 or bool(run.program.scalar_terms))
        first, outer, stuck, last = rho, 0, 0, np.inf
        creeping, beginning, least_yet = 0, run.lin.values, np.inf
        recent: list[float] = []  # violations after the last subproblems
        hopeful = True  # rejected and corrected steps are the exception, and then come in rows
        while run.status is None:
            outer += 1
            run.penalties = penalty = rho * weights
            before = len(run.history)
            stalled = False
            after = primal.next_multipliers(run.lin.constraints, multipliers, penalty)
            slope = primal.slope(run.lin, after)
            while slope > gradient_goal and len(run.history) - before < self.inner_iterations:
                steep = slope
                bend = primal.bend(run.lin, expected) if exact else STRAIGHT
                primal.hopeful, primal.reached = hopeful, None
                taken = damped_step(primal, run.lin, multipliers, penalty, damping, bend)
                if taken is None:
                    stalled = True
                    break
                values, step, rejected = taken
                expected = primal.expected_multipliers(run.lin, step, multipliers, penalty, damping.base)
                lin, hopeful = primal.linearized(values), rejected == 0 and damping.base is run.lin.constraints
                after, slope = expected, primal.slope(lin, expected)
                if not slope <= gradient_goal:
                    plus = primal.next_multipliers(lin.constraints, multipliers, penalty)
                    if not slope < (balance := primal.slope(lin, plus)):
                        after, slope = plus, balance
                if largest(unit) > 1.0 and (less := self._lighter(primal, lin, unit)) is not None:
                    unit, weights, scale = unit * less, weights * less**2, scale * less
                    run.penalties = penalty = rho * weights
                run.accept(
                    lin,
                    after,
                    norm(step),
                    1.0,
                    outer=outer,
                    penalty=rho,
                    damping=damping.value,
                    rejected=rejected,
                )
                if run.status is None and self._stop_rule(run, norm(step)):
                    return Status.STOP_RULE
                if run.status is not None:
                    return None
                if slope > FALLING * steep and norm(step) <= UNSEEN * largest(lin.values.flat):
                    break  # rounding, times rho, is all that is left of the gradient
                if norm(step) < self.step_tolerance:
                    break  # too short to be of use: what violation remains is for the multipliers to remove
            change = largest(scale * (after - multipliers) / penalty)
            if len(run.history) == before:  # nothing moved: the dual step alone is this iteration
                run.accept(run.lin, after, 0.0, 0.0, outer=outer, penalty=rho)
            here, violation = run.lin, run.optimality.violation
            if stalled and (change == 0.0 or rho >= heaviest) and (ending := resume(run, Status.STALLED)) is not None:
                return ending
            falling = violation <= FALLING * last
            lost = run.has_been_feasible and len(recent) == PATIENCE
            lost = lost and violation > max(run.tolerances.violation, FALLING * max(recent))
            last, recent = violation, [*recent, violation][-PATIENCE:]
            stuck = 0 if falling else stuck + 1
            if stuck == PATIENCE and settle(run, Status.STALLED) is Status.LOCALLY_INFEASIBLE:
                return Status.LOCALLY_INFEASIBLE
            if change <= violation_goal and run.lin is here:
                multipliers = after
                if len(run.history) - before <= 1 and not stalled:  # so easy that the next one may be harder
                    rho = max(rho, min(rho * self.penalty_growth, LARGEST_EASY))
                violation_goal = max(min(violation_goal / rho**0.9, FALL * change), least)
                gradient_goal = max(0.1 * gradient_goal, 0.0 if run.program.least_squares else run.enough)
            else:
                if run.lin is here and not falling and (lost or run.infeasible_stationary()):
                    ending = leave(run)
                    if ending is not None and not lost:
                        return ending
                unsolved = len(run.history) - before >= self.inner_iterations
                creeping = creeping + 1 if unsolved and violation > FALL * least_yet else 0
                least_yet = min(least_yet, violation)
                if creeping == PATIENCE and not run.has_been_feasible and run.lin is here:  # rho began too small
                    run.begin_at(run.program.linearize(beginning))
                if run.lin is here and not falling and rho >= heaviest:
                    if (ending := resume(run, Status.STALLED)) is not None:
                        return ending
                if run.lin is not here:  # led astray: from the new point more slowly, and without what was learned
                    creeping, stuck, last, least_yet, recent = 0, 0, np.inf, np.inf, []
                    first *= self.penalty_growth**2
                    rho, damping = min(first, heaviest), Damping(self.damping)
                    multipliers = expected = primal.prices(run.lin)
                    gradient_goal, violation_goal = self._goals(run, primal, rho, multipliers, rho * weights)
                elif rho < heaviest:
                    rho = min(rho * self.penalty_growth, heaviest)
                    gradient_goal, violation_goal = self._goals(run, primal, rho, multipliers, rho * weights)
                else:  # falling, as where constraints have no multipliers
                    multipliers = after
                    gradient_goal = max(0.1 * gradient_goal, run.enough)
            if stalled:
                damping = Damping(self.damping)
        return None

    def _first_penalties(self, run: SolveState, primal: Primal) -> tuple[float, Array]:
        """Initial rho, and (M,) weights of the rows: their penalties are rho times them."""
        scale = self._scale(primal, run.lin)
        weights = scale**2
        if self.penalty is not None:
            return self.penalty, weights
        unit = size_of_costs(run.program, run.lin)
        # With large multipliers the curvature of the constraints can outweigh a small penalty.
        least = WARM_PENALTY * largest(run.multipliers / scale)
        given = run.penalties > 0.0
        if given.any():
            found = np.sort((run.penalties / weights)[given])  # np.median takes longer than the step that follows
            rho = float(0.5 * (found[(len(found) - 1) // 2] + found[len(found) // 2]))
            weights = np.where(given, run.penalties / rho, weights)
        else:
            outside = float(np.square(scale * run.program.violation(run.lin.constraints)).sum())
            size = abs(run.lin.cost - sum(float(each.sum()) for each in run.lin.scalars.values()))
            if run.lin.scalars:  # to which a constant may be added: slopes tell how large they are
                unit, size = STEEP * unit, max(size, STEEP * largest(run.lin.gradient))
            rho = COLD_PENALTY * max(unit, size) / max(1.0, 0.5 * outside)
        return float(np.clip(max(rho, least), 1e-3 * unit, 1e6)), weights

    def _scale(self, primal: Primal, lin: Linearization) -> Array:
        """(M,) factors that make constraints in different units alike, by the length of their gradients at a point.

        The largest entry of the gradient counts, over all factors of a term: one of them may be flat by chance.
        """
        rows = primal.program.constraints
        if not self.scaling or self.schedule != "bcl":
            return np.ones(rows.count)
        scale = np.empty(rows.count)
        _balance(rows.free, rows.free_rows, lin.constraint_jacobian, primal.alike, scale)
        return scale

    def _lighter(self, primal: Primal, lin: Linearization, unit: Array) -> Array | None:
        """(M,) factors that take back some of ``unit`` from rows that looked flat before; None where none does now.

        The square of a speed near rest hardly moves, but where its limit is it does.
        """
        wanted = self._scale(primal, lin)
        less = np.where((unit > 1.0) & (wanted < GROWN * unit), np.maximum(wanted, 1.0) / unit, 1.0)
        return less if (less < 1.0).any() else None

    def _goals(
        self, run: SolveState, primal: Primal, rho: float, multipliers: Array, penalty: Array
    ) -> tuple[float, float]:
        """First accuracy of the subproblem's gradient, and the scaled violation that earns a dual step."""
        if run.program.least_squares:  # one subproblem, and no absolute measure of its gradient
            return 0.0, 1.0
        size = largest(primal.gradient(run.lin, multipliers, penalty))
        return max(min(0.1 * size, 1.0), run.enough), float(max(rho**-0.1, 0.1 * run.tolerances.violation))

    def _stop_rule(self, run: SolveState, step_norm: float) -> bool:
        return step_norm < self.step_tolerance and run.optimality.violation < self.violation_tolerance


def _stiffness(run: SolveState, weights: Array) -> float:
    """Curvatures of the costs over those of the weighed constraints, in the mean and at least one: rho outweighs it."""
    program, lin = run.program, run.lin
    pull = program.constraints.transposed_times(lin.constraint_jacobian**2, weights)[program.columns.free]
    curvatures = lin.hessian[program.normal.diagonal]
    return max(1.0, geometric_mean(curvatures[pull > 0.0] / pull[pull > 0.0]))


@compiled
def _balance(free: IntArray, rows: IntArray, jacobian: Array, alike: IntArray, scale: Array) -> None:
    """Write the factor of every row; rows of one number in ``alike`` get the same."""
    length = np.zeros(len(scale))
    for k in range(len(free)):
        group = alike[rows[k]]
        length[group] = max(length[group], abs(jacobian[free[k]]))
    for row in range(len(scale)):
        size = length[alike[row]] or 1.0
        wanted = min(max(size, SHORTEST), LONGEST) / size
        scale[row] = min(max(wanted, 1.0 / LARGEST_SCALE), LARGEST_SCALE)
