"""The whole interior-point solve, and the table of addresses through which its parts call each other.

It runs without Python where it can, and asks for what only Python can do.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from unifg.codegen.clock import seconds
from unifg.codegen.function_pointers import ADDRESS, NOTHING, NUMBER, TRUTH, link, linked, memory, number, parts, run
from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.elimination.fronts import factor
from unifg.elimination.substitution import solve
from unifg.problem import evaluation
from unifg.problem.evaluation import LinearArrays
from unifg.problem.hessian import add_curvature, add_losses
from unifg.problem.retraction import retract_parts
from unifg.problem.scalars import add_scalars, evaluate_scalars
from unifg.solution.multipliers import raise_slopes, size_of
from unifg.solution.optimality import kkt_numbers
from unifg.solvers.interior_point import barrier, direction, filter_search
from unifg.solvers.interior_point.state import (
    ACCEPTED,
    AGAIN,
    AIMED,
    BEND,
    BENT,
    EVALUATE,
    EVALUATED,
    LINEARIZE,
    LINEARIZED,
    LINKS,
    MEASURED,
    MOVED,
    NO,
    SHOW,
    TESTED,
    TRY,
    UNKNOWN,
    Problem,
    Work,
)
from unifg.typing import Array, Records

FEW = 5  # steps of a tick


@compiled
def call(function: int, address: int) -> None:
    """Run a linked function."""
    run(function, (address,))


@compiled
def fill(target: Array, number: float) -> None:
    """Set all numbers: a slice would do the same and take half a second to compile."""
    for k in range(len(target)):
        target[k] = number


@linked
def advance(address: int) -> None:
    """Move to the trial and evaluate it."""
    fixed, free, links, move, retraction = parts(address, "fixed free links move retraction")
    scalars, scratch, spread, step, terms, trial = parts(address, "scalars scratch spread step terms trial")
    trial_constraints, trial_heights = parts(address, "trial_constraints trial_heights")
    trial_residual, trial_squares = parts(address, "trial_residual trial_squares")
    values, weights = parts(address, "values weights")
    now = scalars[0]
    alpha = now.alpha
    for k in range(len(free)):
        move[k] = alpha * step[k]
    copy_to(values, trial)
    fill(spread, 0.0)
    run(links[0].retract, (retraction, free, move, spread, values, trial))
    for place in fixed:  # retractions wrap and renormalise
        trial[place] = values[place]
    now.trial_cost = number(
        links[0].evaluate,
        (terms, trial, trial_residual, trial_constraints, trial_squares, weights, False, scratch),
    )
    if len(trial_heights):
        now.trial_cost += number(links[0].evaluate_scalars, (terms, trial, trial_heights, scratch))


@linked
def renew(address: int) -> None:
    """Linearise at the present iterate."""
    concavity, constraint_jacobian = parts(address, "concavity constraint_jacobian")
    constraints, gradient, heights, hessian = parts(address, "constraints gradient heights hessian")
    jacobian, links, norms = parts(address, "jacobian links norms")
    residual, scalars, scratch, squares = parts(address, "residual scalars scratch squares")
    terms, values, weights = parts(address, "terms values weights")
    fill(gradient, 0.0)
    fill(hessian, 0.0)
    scalars[0].cost = number(
        links[0].linearize,
        (
            terms, values, residual, jacobian, constraints, constraint_jacobian, squares, weights, norms, gradient,
            hessian, scratch, 0, 1,
        ),
    )  # fmt: skip
    if len(heights):
        fill(concavity, 0.0)
        # Where Gauss-Newton's Hessian is not used, its part of every factor need not be found.
        arrays = terms, values, heights, gradient, hessian, concavity, scratch, scalars[0].definite != NO
        scalars[0].cost += number(links[0].add_scalars, arrays)


@linked
def bend(address: int) -> None:
    """Find the second derivatives of the Lagrangian at the present iterate."""
    concavity, curvature, hessian = parts(address, "concavity curvature hessian")
    jacobian, links = parts(address, "jacobian links")
    multipliers, residual, squares, terms = parts(address, "multipliers residual squares terms")
    values, weights = parts(address, "values weights")
    copy_to(hessian, curvature)
    for k in range(len(concavity)):
        curvature[k] += concavity[k]
    run(links[0].curve, (terms, values, residual, weights, multipliers, curvature))
    if len(weights):
        run(links[0].weigh, (terms, residual, jacobian, squares, weights, curvature))


@linked
def reset(address: int) -> None:
    """Forget the last solve."""
    row_units, scalars, shift, units = parts(address, "row_units scalars shift units")
    steepest_gradient, steepest_jacobian = parts(address, "steepest_gradient steepest_jacobian")
    now = scalars[0]
    now.asked, now.iteration, now.kept, now.raises, now.definite = 0.0, 0, 0, 0, UNKNOWN
    now.finer, now.concluded, now.theta_most = 1.0, 0, math.inf
    now.evaluating = now.solving = now.judging = 0.0
    fill(row_units, 1.0)
    fill(units, 1.0)
    fill(shift, 0.0)
    fill(steepest_gradient, 0.0)
    fill(steepest_jacobian, 0.0)


@linked
def split(address: int) -> None:
    """Linearise at the present iterate with Gauss-Newton's Hessian, where the loop does without."""
    links, scalars = parts(address, "links scalars")
    known, scalars[0].definite = scalars[0].definite, UNKNOWN
    run(links[0].renew, (address,))
    scalars[0].definite = known


@linked
def conclude(address: int) -> None:
    """Judge the last iterate as every backend is judged."""
    constraint_jacobian, constraints, free = parts(address, "constraint_jacobian constraints free")
    full, gradient, kkt, links, multipliers = parts(address, "full gradient kkt links multipliers")
    scalars, steepest_gradient, terms = parts(address, "scalars steepest_gradient terms")
    jacobian, measures, residual, sizes = parts(address, "jacobian measures residual sizes")
    hessian, steepest_jacobian = parts(address, "hessian steepest_jacobian")
    now = scalars[0]
    if now.concluded == 1:
        return
    began = seconds(now.clock)
    run(links[0].raise_slopes, (constraint_jacobian, gradient, steepest_jacobian, steepest_gradient))
    arrays = terms, multipliers, steepest_jacobian, steepest_gradient, free, now.tolerance
    now.suspicion = number(links[0].size_of, arrays)
    memory = free, measures.coordinates, sizes, now.violation_unit, now.tolerance
    derivatives = gradient, measures.diagonal, hessian, residual, jacobian, constraints, constraint_jacobian
    run(links[0].kkt_numbers, (terms, *memory, *derivatives, multipliers, full, kkt))
    now.judging += seconds(now.clock) - began


@linked
def loop(address: int) -> None:
    """Iterate from ``work.values``, which is moved, to one of the endings.

    Where Python has to do something it is asked by the answer, and the loop goes on at its stage when called again: for
    numbers if ``assisted``, to show every iterate if ``watched``, and before every direction, where the answer is to
    try it, if ``clocked``.
    """
    constraint_jacobian, gradient, links, scalars = parts(address, "constraint_jacobian gradient links scalars")
    steepest_gradient, steepest_jacobian = parts(address, "steepest_gradient steepest_jacobian")
    heights, trial, values = parts(address, "heights trial values")
    now = scalars[0]
    python, watched, stage = now.assisted == 1, now.watched == 1, now.stage
    while True:
        if stage == MOVED:
            if python:
                now.answer, now.stage = LINEARIZE, LINEARIZED
                return
            began = seconds(now.clock)
            run(links[0].renew, (address,))
            now.evaluating += seconds(now.clock) - began
            stage = LINEARIZED
        if stage == LINEARIZED:
            if now.going_on == 0:
                arrays = constraint_jacobian, gradient, steepest_jacobian, steepest_gradient
                run(links[0].raise_slopes, arrays)
            run(links[0].measure if now.going_on == 1 else links[0].begin, (address,))
            now.going_on, stage = 1, MEASURED
            if watched:
                now.answer, now.stage = SHOW, MEASURED
                return
        if stage == MEASURED:
            run(links[0].test, (address,))
            if now.answer != TRY:
                return
            stage = TESTED
            if now.clocked == 1:
                now.stage = TESTED
                return
        if stage == TESTED:
            stage = BENT
            # Second derivatives need multipliers, and those of a cold start mean little. They pay where steps converge,
            # not in the first few of a tick that ends with the first plan that keeps the constraints.
            few = now.step_tolerance == math.inf and now.iteration < FEW and len(heights) == 0
            known = now.cold == 0 or now.iteration > 0 or now.estimated == 1
            now.bending = 1 if now.exact == 1 and known and not (few and now.cold == 0) else 0
            if now.bending == 1:
                if python:
                    now.answer, now.stage = BEND, BENT
                    return
                began = seconds(now.clock)
                run(links[0].bend, (address,))
                now.evaluating += seconds(now.clock) - began
        if stage == AIMED:
            if python:
                now.answer, now.stage = EVALUATE, EVALUATED
                return
            began = seconds(now.clock)
            run(links[0].advance, (address,))
            now.evaluating += seconds(now.clock) - began
        if stage == BENT:
            began = seconds(now.clock)
            run(links[0].direct, (address,))
            now.solving += seconds(now.clock) - began
        else:
            run(links[0].judge, (address,))
        stage = AIMED
        if now.answer == ACCEPTED:
            copy_to(trial, values)
            stage = MOVED
        elif now.answer == AGAIN:
            stage = MEASURED
        elif now.answer != TRY:
            return


@linked
def solve_once(address: int) -> None:
    """One solve that asks nobody: forget the last one, iterate, judge."""
    (links,) = parts(address, "links")
    run(links[0].reset, (address,))
    run(links[0].loop, (address,))
    run(links[0].conclude, (address,))


@cache
def addresses(robust: bool, general: bool) -> Records:
    """Compile everything for the arrays that ``memory`` has seen, and say where it stands.

    Args:
        robust: what robust losses need as well.
        general: what costs that are no squares need as well.
    """
    problem, work = memory.kind
    kinds = {**dict(zip(Problem._fields, problem, strict=True)), **dict(zip(Work._fields, work, strict=True))}
    values, residual, constraints, vector = (kinds[name] for name in ("values", "residual", "constraints", "step"))
    terms, scratch = kinds["terms"], kinds["scratch"]
    linearized = [kinds[name] for name in LinearArrays._fields]
    links = np.zeros(1, LINKS)
    links[0]["factor"] = link(factor, TRUTH, kinds["plan"], kinds["data"], vector)
    links[0]["solve"] = link(solve, NOTHING, kinds["plan"], vector, vector)
    links[0]["linearize"] = link(evaluation.linearize, NUMBER, terms, values, *linearized, scratch, ADDRESS, ADDRESS)
    links[0]["evaluate"] = link(
        evaluation.evaluate,
        NUMBER,
        terms,
        values,
        residual,
        constraints,
        kinds["squares"],
        kinds["weights"],
        TRUTH,
        scratch,
    )
    links[0]["curve"] = link(
        add_curvature, NOTHING, terms, values, residual, kinds["weights"], constraints, kinds["hessian"]
    )
    if robust:
        norms = kinds["squares"], kinds["weights"]
        links[0]["weigh"] = link(add_losses, NOTHING, terms, residual, kinds["jacobian"], *norms, kinds["hessian"])
    if general:
        heights, added = kinds["heights"], (kinds["gradient"], kinds["hessian"], kinds["concavity"])
        links[0]["evaluate_scalars"] = link(evaluate_scalars, NUMBER, terms, values, heights, scratch)
        links[0]["add_scalars"] = link(add_scalars, NUMBER, terms, values, heights, *added, scratch, TRUTH)
    links[0]["retract"] = link(
        retract_parts, NOTHING, kinds["retraction"], kinds["free"], vector, kinds["spread"], values, values
    )
    rows, gradient, free = kinds["constraint_jacobian"], kinds["gradient"], kinds["free"]
    links[0]["kkt_numbers"] = link(
        kkt_numbers,
        NOTHING,
        terms,
        free,
        free,
        kinds["sizes"],
        NUMBER,
        NUMBER,
        gradient,
        free,
        kinds["hessian"],
        residual,
        kinds["jacobian"],
        constraints,
        rows,
        constraints,
        gradient,
        kinds["kkt"],
    )
    links[0]["raise_slopes"] = link(raise_slopes, NOTHING, rows, gradient, rows, gradient)
    links[0]["size_of"] = link(size_of, NUMBER, terms, constraints, rows, gradient, free, NUMBER)
    functions = {
        "begin": barrier.begin,
        "measure": barrier.measure,
        "test": barrier.test,
        "judge": filter_search.judge,
        "correct": filter_search.correct,
        "relax": barrier.relax,
        "increase_penalty": barrier.increase_penalty,
        "restore": filter_search.restore,
        "accept": filter_search.accept,
        "direct": direction.direct,
        "assemble": direction.assemble,
        "examine": direction.examine,
        **({"estimate": direction.estimate, "split": split} if general else {}),
        "steer": direction.steer,
        "advance": advance,
        "renew": renew,
        "bend": bend,
        "loop": loop,
        "reset": reset,
        "conclude": conclude,
        "solve_once": solve_once,
    }
    for name, function in functions.items():
        links[0][name] = link(function, NOTHING, ADDRESS)
    return links
