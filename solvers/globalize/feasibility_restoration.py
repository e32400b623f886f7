"""Feasibility restoration: the nearest point of least violation, for constraints that cannot be met.

A merit function or an elastic problem stalls at a point that is stationary for its own measure of violation. From there
a damped Newton method on 1/2 |violation|^2 finds a point that is stationary for the measure of
:func:`unifg.solution.optimality.infeasible_stationary`, within the bounds of the unknowns, or a feasible one; then
nothing is proved.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.symmetric import Symmetric
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.optimality import infeasible_stationary, within_bounds
from unifg.solution.solve_state import SolveState
from unifg.solution.status import Status
from unifg.solution.violation import ViolationModel, bounds_of_step, descent
from unifg.solvers.globalize.norms import norm
from unifg.typing import Array

STEPS = 200
FIRST_DAMPING, LARGEST_DAMPING, GROWTH, SHRINK = 1e-3, 1e10, 4.0, 0.2
PROGRESS = 1e-12  # smallest relative decrease that counts; below it, the gradient has to halve
ROUNDING = 1e-14
ASIDE = 1e-3  # standard deviation of the step off a point that may be a saddle
PATIENCE = 20  # iterations whose violation has not fallen
FALLING = 0.9
ASTRAY = 0.1  # of the squared violation: where the least so far is less than this share, iterates have gone astray
SMALLER = 0.25  # of the squared violation: where restoration has ended, to go on from there
ROUNDS = 5  # of holding unknowns that a step would move past a bound
LESS = 1e-4  # relative decrease that tells a saddle from a minimum in a flat valley


def settle(run: SolveState, status: Status) -> Status:
    """End a solve that stalled: LOCALLY_INFEASIBLE at the point of least violation, else ``status`` where it is.

    A solve that has met its constraints somewhere has seen that they can be met: it stays where it is.
    """
    found = _settled(run)
    return status if found is None or found[1] is False else Status.LOCALLY_INFEASIBLE


def resume(run: SolveState, status: Status) -> Status | None:
    """End a solve that stalled as :func:`settle` does, or None once the iterate was moved to where it may go on.

    See :func:`goes_on`; that it is feasible there happens once. Multipliers begin anew.
    """
    found = _settled(run)
    if found is None or found[1]:
        return status if found is None else Status.LOCALLY_INFEASIBLE
    if not goes_on(run, found[0]):
        return status
    run.multipliers = np.zeros(len(run.multipliers))
    run.begin_at(found[0])
    return run.status


def goes_on(run: SolveState, found: Linearization) -> bool:
    """Note where a restoration ended; true if that is feasible, or violates less than half of here and the last end."""
    before, run.resumed = min(_squared(run.program, run.lin), run.resumed), _squared(run.program, found)
    return not run.violates(found.constraints) or run.resumed < SMALLER * before


def _settled(run: SolveState) -> tuple[Linearization, bool] | None:
    """As :func:`nearest`, where the solve then ends if it is least; None where that is not asked."""
    if run.status is not None or run.has_been_feasible:
        return None
    found, least = nearest(run)
    if least:
        run.begin_at(found)
        run.status = Status.LOCALLY_INFEASIBLE
    return found, least


def nearest(run: SolveState) -> tuple[Linearization, bool]:
    """End of the descent on the violation from the present iterate, and true if nothing near violates less."""
    found = descended(run)
    while infeasible_stationary(run.program, found, run.tolerances.violation):
        lower = _downhill(run, found)
        if lower is None:
            return found, True
        found = lower
    return found, False


def descended(run: SolveState) -> Linearization:
    """End of a descent on the violation from the present iterate, or from the least violated if that is far below."""
    program, violation = run.program, run.tolerances.violation
    found, least = (within_bounds(program, lin) for lin in (run.lin, program.linearize(run.least_violated)))
    if _squared(program, least) < ASTRAY * _squared(program, found):  # NaN is not less
        found = least
    if not infeasible_stationary(program, found, violation):
        found = least_violation(program, found, violation, run.begin_restoration_step)
        if run.violates(found.constraints):  # the next time goes on from there
            run.look_at(found)
    return found


def leave(run: SolveState) -> Status | None:
    """LOCALLY_INFEASIBLE at a stationary violation; None after the iterate was moved to violate less."""
    within = within_bounds(run.program, run.lin)
    found = _downhill(run, within)
    if found is None:
        return Status.LOCALLY_INFEASIBLE
    run.begin_at(found)
    return run.status


def _downhill(run: SolveState, lin: Linearization) -> Linearization | None:
    """A point that violates less than a stationary one; None at a minimum.

    It is looked for from where the solve has been, then from beside, off a saddle, at two distances: one in the units
    of the unknowns, and one that is the same in any unit, but tells nothing where the violation is flat.
    """
    program = run.program
    direction = ASIDE * np.random.default_rng(0).standard_normal(program.size)
    here = _squared(program, lin)
    starts = [run.least_violated, program.retract(lin.values, direction)]
    starts.append(program.retract(lin.values, ViolationModel(program, lin).lengths * direction))
    for k, values in enumerate(starts):
        start = program.linearize(values)
        if not start.finite or (k == 0 and not _squared(program, start) < (1.0 - LESS) * here):
            continue
        found = least_violation(program, start, run.tolerances.violation, run.begin_restoration_step, convex=k > 0)
        if found.finite and _squared(program, found) < (1.0 - LESS) * here:
            return found
    return None


def _squared(program: CompiledProblem, lin: Linearization) -> float:
    return float((program.violation(lin.constraints) ** 2).sum())


def least_violation(
    program: CompiledProblem,
    lin: Linearization,
    tolerance: float,
    out_of_time: Callable[[], bool] = lambda: False,
    convex: bool = False,
) -> Linearization:
    """Descend on the violation until it is stationary, gone, or nothing helps.

    Unknowns at a bound that holds them back are held there for the step, and so are those that would pass one: the
    others take that into account. Damping is relative to the largest curvature that each unknown has shown (More, The
    Levenberg-Marquardt algorithm, 1978), so units do not matter.

    Args:
        program: the compiled graph.
        lin: where to begin.
        tolerance: largest violation that counts as none.
        out_of_time: asked before every step whether to end where it is.
        convex: take no step of an indefinite model, which may lead to a saddle; slow where some direction stays so.
    """
    solver = program.systems.normal()
    lin = within_bounds(program, lin)
    damping, size = FIRST_DAMPING, np.zeros(program.size)
    for _ in range(STEPS):
        outside = program.violation(lin.constraints)
        if np.abs(outside).max(initial=0.0) <= tolerance:
            return lin
        model = ViolationModel(program, lin)
        if model.stationary(tolerance) or out_of_time():
            return lin
        size, room = np.maximum(size, model.size), bounds_of_step(program, lin)
        while damping <= LARGEST_DAMPING:
            entries = model.damped(damping, size)
            if solver.factor(entries) and (solver.definite or not convex):
                step = _bounded(solver, program.normal, entries, model.gradient, room)
                values = program.within_bounds(program.retract(lin.values, step))
                trial = program.evaluate(values)
                there = 0.5 * float((program.violation(trial.constraints) ** 2).sum()) if trial.finite else np.inf
                if there < (1.0 - PROGRESS) * model.value:
                    break
                if there <= (1.0 + ROUNDING) * model.value:
                    after, _ = descent(program, program.linearize(values))
                    if norm(after / np.sqrt(size)) <= 0.5 * norm(model.gradient / np.sqrt(size)):
                        break
            damping *= GROWTH
        else:
            return lin
        lin = program.linearize(values)
        damping *= SHRINK
    return lin


def _bounded(
    solver: Factorization, normal: Symmetric, entries: Array, gradient: Array, room: tuple[Array, Array]
) -> Array:
    """Minimise a factorised model; while it is convex, with unknowns that would pass a bound held there."""
    step, (lower, upper) = -solver.solve(gradient), room
    held = np.zeros(normal.size, dtype=bool)
    for _ in range(ROUNDS):
        passed = ((step < lower) | (step > upper)) & ~held
        if not solver.definite or not passed.any():
            break
        held |= passed
        fixed = np.where(held, np.clip(step, lower, upper), 0.0)
        right = np.where(held, 0.0, -gradient - normal.times(entries, fixed))
        reduced = entries.copy()
        reduced[held[normal.indices] | held[normal.columns]] = 0.0
        reduced[normal.diagonal[held]] = 1.0
        if not solver.factor(reduced) or not solver.definite:
            break
        step = solver.solve(right) + fixed
    return step


class RestorationTrigger:
    """Calls for a look at the violation alone when it has not fallen for long.

    Where constraints miss each other by little, every linearisation may have a solution, while steps only get shorter
    and multipliers longer. Whether there is a feasible point, a descent on the violation tells.
    """

    def __init__(self) -> None:
        """Begin to count."""
        self._patience, self._waited = PATIENCE, 0
        self._least = np.inf

    @property
    def left(self) -> int:
        """Iterations that may follow before it can be time, at least one."""
        return self._patience - self._waited

    def calls(self, violation: float, tolerance: float) -> bool:
        """Test whether it is time; asked once an iteration, and after every call half as often."""
        if violation <= tolerance or violation < FALLING * self._least:
            self._least, self._waited = min(violation, self._least), 0
            return False
        self._waited += 1
        if self._waited < self._patience:
            return False
        self._patience, self._waited = 2 * self._patience, 0
        return True
