"""The iterations of SQP, compiled: from the start, or from a step to the next, as far as the graph's answers lead.

What only Python can do is asked for as within an attempt; so are, by the budget, its rules about many iterations. The
log tells it of every iterate since, as if it had looked at each.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.clock import seconds
from unifg.codegen.function_pointers import Memory, all_of, holds, linked_to
from unifg.codegen.jit import compiled
from unifg.problem.limits import clip
from unifg.problem.table import TermArrays
from unifg.solution.multipliers import raise_slopes
from unifg.solution.optimality import kkt_numbers
from unifg.solution.solve_state import UNBOUNDED_COST
from unifg.solvers.globalize.merit import FARTHEST
from unifg.solvers.quadratic_programs.attempt import (
    FIND_UNITS,
    LOGGED,
    POSED,
    SMALLEST_DAMPING,
    STARTED,
    STOPPED,
    TAKEN,
    UNBEGUN,
    Problem,
    Work,
    attempt,
    linearize,
    scaled_violation,
)
from unifg.solvers.quadratic_programs.graph_route import PATIENCE
from unifg.typing import Array, Records

# Numbers of an iterate in the log, before norms and heights, stored values, constraints and multipliers.
SHOWN, COST, STATIONARITY, VIOLATION, COMPLEMENTARITY, SIZE, LENGTH, SECONDS, DAMPING, ITERATIONS, BEGUN = range(11)
NUMBERED = 11

arrays = Memory()  # of Problem and Work: Numba takes 25 us to unpack them in every call
found = all_of(arrays)


@linked_to(arrays)
def loop(address: int) -> None:
    """Go on at a stage of an attempt; alone, go on with further ones until Python has to look."""
    problem, work = found(address)
    now = work.scalars[0]
    if now.stage == UNBEGUN:
        now.answer = TAKEN if _begin(problem, work) else STARTED
        if now.answer == STARTED or now.budget == 0:
            return
    while True:
        if now.alone == 1:
            size = kkt_size(work.kkt[0], work.kkt[1], work.kkt[2], work.kkt[5])
            now.accuracy = useful_accuracy(False, size, now.tolerance, min(1.0, work.kkt[5]))
            now.damping, now.stage = max(now.next_damping, now.missing), POSED
            if now.logged > 0:
                work.log[(now.logged - 1) * (len(work.log) // LOGGED) + BEGUN] = 1.0
        attempt(problem, work)
        if now.alone == 0 or now.answer != TAKEN:
            return
        now.moved, now.iteration, now.budget = 1, now.iteration + 1, now.budget - 1
        if not _record(problem, work, True):
            return
        if rests(now.size, work.kkt[1], now.step_tolerance, now.violation_tolerance):
            now.answer = STOPPED
            return
        if now.budget == 0:
            return


@compiled
def _begin(problem: Problem, work: Work) -> bool:
    """Linearise at the trial, brought within the bounds, and find units; false where Python has to look."""
    now, terms = work.scalars[0], problem.terms
    now.iteration, now.size, now.length, now.moved = 0, 0.0, 0.0, 1
    work.steepest_jacobian[:] = 0.0
    work.steepest_gradient[:] = 0.0
    linearize(problem, work)
    if not _record(problem, work, True):
        return False
    # Bounds are linear: once they hold they hold along every step, and leave the line search to the rest.
    outside = False
    for row in problem.bounds:
        value = work.next_constraints[row]
        outside = outside or value < terms.lower[row] or value > terms.upper[row]
    if outside and now.full_steps == 0:
        clip(work.trial, problem.bounded, problem.bounds, terms.lower, terms.upper)
        for k in range(len(problem.fixed)):
            work.trial[problem.fixed[k]] = problem.fixed_values[k]
        linearize(problem, work)
        if not _record(problem, work, False):
            return False
    if now.scaling == 1:
        units = problem.units, work.next_hessian, work.next_jacobian, work.columns, work.rows, True
        if not holds(problem.links[FIND_UNITS], units):
            return False
    work.columns[:] = 1.0
    work.rows[:] = 1.0
    forget(terms, work.scalars, work.rows, work.penalties, work.multipliers, work.next_constraints)
    return True


@compiled
def forget(
    terms: TermArrays, scalars: Records, rows: Array, penalties: Array, multipliers: Array, constraints: Array
) -> None:
    """Begin with nothing learned but the penalties that the multipliers suggest.

    Args:
        terms: of the program.
        scalars: (1,) of ``NOW``.
        rows: (M,) factors of scaled units.
        penalties: (M,) of the merit, which are set.
        multipliers: (M,) of the guess.
        constraints: (M,) at the start.
    """
    now = scalars[0]
    now.next_damping, now.missing, now.patience = SMALLEST_DAMPING, 0.0, PATIENCE
    now.farthest = FARTHEST * max(1.0, scaled_violation(constraints, terms.lower, terms.upper, rows))
    for row in range(len(penalties)):
        penalties[row] = abs(multipliers[row])


@compiled
def _record(problem: Problem, work: Work, shown: bool) -> bool:
    """Judge the trial, the new iterate, and log it; false where the solve ends there or Python has to look."""
    now, kkt, log = work.scalars[0], work.kkt, work.log
    raise_slopes(work.next_jacobian, work.next_gradient, work.steepest_jacobian, work.steepest_gradient)
    kkt_numbers(
        problem.terms, problem.free, problem.coordinates, problem.sizes, now.violation_unit, now.tolerance,
        work.next_gradient, problem.diagonal, work.next_hessian, work.residual, work.jacobian, work.next_constraints,
        work.next_jacobian, work.multipliers, work.full, kkt,
    )  # fmt: skip
    finite = kkt[4] != 0.0 and math.isfinite(now.next_cost)
    if not finite:
        kkt[0] = kkt[1] = kkt[2] = np.inf
    at = now.logged * (len(log) // LOGGED)
    log[at + SHOWN], log[at + COST], log[at + SIZE] = 1.0 if shown else 0.0, now.next_cost, now.size
    log[at + STATIONARITY], log[at + VIOLATION], log[at + COMPLEMENTARITY] = kkt[0], kkt[1], kkt[2]
    log[at + LENGTH], log[at + SECONDS], log[at + DAMPING] = now.length, seconds(now.clock), now.damping
    log[at + ITERATIONS], log[at + BEGUN] = now.iterations, 0.0
    at += NUMBERED
    for part in (work.norms, work.heights, work.trial, work.next_constraints, work.multipliers):
        for number in part:
            log[at] = number
            at += 1
    now.logged += 1
    sound = finite and now.next_cost >= UNBOUNDED_COST and kkt[0] < np.inf
    met = max(kkt[0], kkt[2]) <= now.tolerance and kkt[1] <= now.feasible
    return sound and not met and now.iteration < now.limit


@compiled
def kkt_size(stationarity: float, violation: float, complementarity: float, slope: float) -> float:
    """The largest KKT number, in the unit of the costs, of which ``slope`` is a gradient that counts as one."""
    return max(slope * stationarity, violation, min(1.0, slope) * complementarity)


@compiled
def useful_accuracy(exact: bool, size: float, tolerance: float, smallest: float) -> float:
    """Accuracy of a subproblem that the outer iteration can use.

    Args:
        exact: whether the Hessian is that of the Lagrangian.
        size: largest KKT number of the iterate, in scaled units.
        tolerance: of the KKT test.
        smallest: factor of a scaled unit, or size of the costs. Where one is worth many of the graph's, or costs are
            small, its test needs more digits.
    """
    share = min(1e-3, size) if exact else 1e-3
    return min(max(share * size, 0.1 * tolerance * smallest), 1e-4)


@compiled
def rests(size: float, violation: float, step_tolerance: float, violation_tolerance: float) -> bool:
    """Stop rule of control loops, on the norm of a step and the violation where it ends."""
    return size < step_tolerance and violation < violation_tolerance
