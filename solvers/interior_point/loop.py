"""The whole interior-point solve without Python, and the table of addresses through which its parts call each other."""

from __future__ import annotations

from functools import cache

import numpy as np

from unifg.elimination.fronts import factor
from unifg.elimination.substitution import solve
from unifg.machine.jit import compiled
from unifg.machine.links import ADDRESS, NOTHING, NUMBER, TRUTH, link, linked, memory, number, parts, run
from unifg.program import passes
from unifg.program.curvature import add_curvature, add_losses
from unifg.program.retraction import retract_parts
from unifg.solvers.interior_point import barrier, direction, filter_search
from unifg.solvers.interior_point.state import ACCEPTED, AGAIN, LINKS, TRY, Problem, Records, Work
from unifg.typing import Array


@compiled
def call(function: int, address: int) -> None:
    """Run a linked function."""
    run(function, (address,))


@compiled
def copy(source: Array, target: Array) -> None:
    """Copy numbers: slices would do the same and take half a second to compile."""
    for k in range(len(source)):
        target[k] = source[k]


@compiled
def fill(target: Array, number: float) -> None:
    """Set all numbers."""
    for k in range(len(target)):
        target[k] = number


@linked
def advance(address: int) -> None:
    """Move to the trial and evaluate it."""
    free, links, move, retraction, scalars = parts(address, "free links move retraction scalars")
    scratch, spread, squares, step, terms, weights = parts(address, "scratch spread squares step terms weights")
    trial, trial_constraints, trial_residual = parts(address, "trial trial_constraints trial_residual")
    (values,) = parts(address, "values")
    now = scalars[0]
    alpha = now.alpha
    for k in range(len(free)):
        move[k] = alpha * step[k]
    copy(values, trial)
    fill(spread, 0.0)
    run(links[0].retract, (retraction, free, move, spread, values, trial))
    now.trial_cost = number(
        links[0].evaluate,
        (terms, trial, trial_residual, trial_constraints, squares, weights, False, scratch),
    )


@linked
def loop(address: int) -> None:
    """Iterate from ``work.values``, which is moved, to one of the endings.

    With a clock to be watched it returns before every direction, and goes on from there when it is called again.
    """
    constraint_jacobian, constraints = parts(address, "constraint_jacobian constraints")
    curvature, gradient, hessian, jacobian = parts(address, "curvature gradient hessian jacobian")
    links, multipliers, norms, residual = parts(address, "links multipliers norms residual")
    scalars, scratch, squares, terms, trial = parts(address, "scalars scratch squares terms trial")
    values, weights = parts(address, "values weights")
    now = scalars[0]
    started, looked = now.going_on > 0, now.going_on == 2
    moved = not looked
    while True:
        if moved:
            fill(gradient, 0.0)
            fill(hessian, 0.0)
            now.cost = number(
                links[0].linearize,
                (
                    terms,
                    values,
                    False,
                    residual,
                    jacobian,
                    constraints,
                    constraint_jacobian,
                    squares,
                    weights,
                    norms,
                    gradient,
                    hessian,
                    scratch,
                ),
            )
            run(links[0].measure if started else links[0].begin, (address,))
            started = True
        if not looked:
            run(links[0].test, (address,))
            if now.answer == TRY and now.clocked == 1:
                now.going_on = 2
                return
        looked = False
        if now.answer == TRY:
            if now.exact == 1 and (now.iteration > 0 or now.cold == 0):
                copy(hessian, curvature)
                run(links[0].curve, (terms, values, residual, weights, multipliers, curvature))
                if len(weights):
                    run(links[0].bend, (terms, residual, jacobian, squares, weights, curvature))
            run(links[0].direct, (address,))
        while now.answer == TRY:
            run(links[0].advance, (address,))
            run(links[0].judge, (address,))
        moved = now.answer == ACCEPTED
        if moved:
            copy(trial, values)
        elif now.answer != AGAIN:
            return


@cache
def addresses() -> Records:
    """Compile everything for the arrays that ``memory`` has seen, and say where it stands."""
    problem, work = memory.kind
    kinds = {**dict(zip(Problem._fields, problem, strict=True)), **dict(zip(Work._fields, work, strict=True))}
    values, residual, constraints, vector = (kinds[name] for name in ("values", "residual", "constraints", "step"))
    terms, scratch = kinds["terms"], kinds["scratch"]
    linearized = [residual, kinds["jacobian"], constraints, kinds["constraint_jacobian"], kinds["squares"]]
    linearized += [kinds["weights"], kinds["norms"], kinds["gradient"], kinds["hessian"], scratch]
    links = np.zeros(1, LINKS)
    links[0]["factor"] = link(factor, TRUTH, kinds["plan"], kinds["data"], vector)
    links[0]["solve"] = link(solve, NOTHING, kinds["plan"], vector, vector)
    links[0]["linearize"] = link(passes.linearize, NUMBER, terms, values, TRUTH, *linearized)
    links[0]["evaluate"] = link(
        passes.evaluate,
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
    robust = kinds["squares"], kinds["weights"]
    links[0]["bend"] = link(add_losses, NOTHING, terms, residual, kinds["jacobian"], *robust, kinds["hessian"])
    links[0]["retract"] = link(
        retract_parts, NOTHING, kinds["retraction"], kinds["free"], vector, kinds["spread"], values, values
    )
    functions = {
        "begin": barrier.begin,
        "measure": barrier.measure,
        "test": barrier.test,
        "judge": filter_search.judge,
        "correct": filter_search.correct,
        "relax": barrier.relax,
        "restore": filter_search.restore,
        "accept": filter_search.accept,
        "direct": direction.direct,
        "steer": direction.steer,
        "advance": advance,
        "loop": loop,
    }
    for name, function in functions.items():
        links[0][name] = link(function, NOTHING, ADDRESS)
    return links
