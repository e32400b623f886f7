"""The whole interior-point solve without Python, and the table of addresses through which its parts call each other."""

from __future__ import annotations

from functools import cache

import numpy as np

from unifg.elimination.fronts import factor
from unifg.elimination.substitution import solve
from unifg.machine.jit import compiled
from unifg.machine.links import ADDRESS, NOTHING, NUMBER, TRUTH, link, linked, memory, number, parts, run
from unifg.program import passes
from unifg.program.curvature import add_curvature
from unifg.program.retraction import retract_parts
from unifg.solvers.interior_point import barrier, direction, filter_search
from unifg.solvers.interior_point.state import (
    ACCEPT,
    ACCEPTED,
    ADVANCE,
    AGAIN,
    ALPHA,
    ANSWER,
    BEGIN,
    COLD,
    CORRECT,
    COST,
    CURVE,
    DIRECT,
    EVALUATE,
    EXACT,
    FACTOR,
    GOING_ON,
    ITERATION,
    JUDGE,
    LINEARIZE,
    LINKS,
    LOOP,
    MEASURE,
    RELAX,
    RESTORE,
    RETRACT,
    SOLVE,
    STEER,
    TEST,
    TRIAL_COST,
    TRY,
    Problem,
    Work,
)
from unifg.typing import Array, IntArray


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
    free, links, move, numbers, retraction = parts(address, "free links move numbers retraction")
    scratch, spread, squares, step, terms, trial = parts(address, "scratch spread squares step terms trial")
    trial_constraints, trial_residual, values = parts(address, "trial_constraints trial_residual values")
    alpha = numbers[ALPHA]
    for k in range(len(free)):
        move[k] = alpha * step[k]
    copy(values, trial)
    fill(spread, 0.0)
    run(links[RETRACT], (retraction, free, move, spread, values, trial))
    numbers[TRIAL_COST] = number(
        links[EVALUATE],
        (terms, trial, trial_residual, trial_constraints, squares, scratch),
    )


@linked
def loop(address: int) -> None:
    """Iterate from ``work.values``, which is moved, to one of the endings."""
    constraint_jacobian, constraints, counts = parts(address, "constraint_jacobian constraints counts")
    curvature, gradient, hessian, jacobian, links = parts(address, "curvature gradient hessian jacobian links")
    multipliers, norms, numbers, residual, scratch = parts(address, "multipliers norms numbers residual scratch")
    squares, terms, trial, values = parts(address, "squares terms trial values")
    moved, started = True, counts[GOING_ON] == 1
    while True:
        if moved:
            fill(gradient, 0.0)
            fill(hessian, 0.0)
            numbers[COST] = number(
                links[LINEARIZE],
                (
                    terms,
                    values,
                    False,
                    residual,
                    jacobian,
                    constraints,
                    constraint_jacobian,
                    squares,
                    norms,
                    gradient,
                    hessian,
                    scratch,
                ),
            )
            run(links[MEASURE if started else BEGIN], (address,))
            started = True
        run(links[TEST], (address,))
        if counts[ANSWER] == TRY:
            if counts[EXACT] == 1 and (counts[ITERATION] > 0 or counts[COLD] == 0):
                copy(hessian, curvature)
                run(links[CURVE], (terms, values, residual, multipliers, curvature))
            run(links[DIRECT], (address,))
        while counts[ANSWER] == TRY:
            run(links[ADVANCE], (address,))
            run(links[JUDGE], (address,))
        moved = counts[ANSWER] == ACCEPTED
        if moved:
            copy(trial, values)
        elif counts[ANSWER] != AGAIN:
            return


@cache
def addresses() -> IntArray:
    """Compile everything for the arrays that ``memory`` has seen, and say where it stands."""
    problem, work = memory.kind
    kinds = {**dict(zip(Problem._fields, problem, strict=True)), **dict(zip(Work._fields, work, strict=True))}
    values, residual, constraints, vector = (kinds[name] for name in ("values", "residual", "constraints", "step"))
    terms, scratch = kinds["terms"], kinds["scratch"]
    linearized = [residual, kinds["jacobian"], constraints, kinds["constraint_jacobian"], kinds["squares"]]
    linearized += [kinds["norms"], kinds["gradient"], kinds["hessian"], scratch]
    links = np.zeros(LINKS, dtype=np.int64)
    links[FACTOR] = link(factor, TRUTH, kinds["plan"], kinds["data"], vector)
    links[SOLVE] = link(solve, NOTHING, kinds["plan"], vector, vector)
    links[LINEARIZE] = link(passes.linearize, NUMBER, terms, values, TRUTH, *linearized)
    links[EVALUATE] = link(passes.evaluate, NUMBER, terms, values, residual, constraints, kinds["squares"], scratch)
    links[CURVE] = link(add_curvature, NOTHING, terms, values, residual, constraints, kinds["hessian"])
    links[RETRACT] = link(
        retract_parts, NOTHING, kinds["retraction"], kinds["free"], vector, kinds["spread"], values, values
    )
    functions = {
        BEGIN: barrier.begin,
        MEASURE: barrier.measure,
        TEST: barrier.test,
        JUDGE: filter_search.judge,
        CORRECT: filter_search.correct,
        RELAX: barrier.relax,
        RESTORE: filter_search.restore,
        ACCEPT: filter_search.accept,
        DIRECT: direction.direct,
        STEER: direction.steer,
        ADVANCE: advance,
        LOOP: loop,
    }
    for place, function in functions.items():
        links[place] = link(function, NOTHING, ADDRESS)
    return links
