"""The whole interior-point solve without Python, and the table of addresses through which its parts call each other."""

from __future__ import annotations

from functools import cache

import numpy as np

from unifg import passes
from unifg.curvature import add_curvature
from unifg.elimination.fronts import factor
from unifg.elimination.substitution import solve
from unifg.jit import compiled
from unifg.retraction import retract_parts
from unifg.solvers import barrier, barrier_direction
from unifg.solvers.barrier_links import ADDRESS, NOTHING, NUMBER, TRUTH, link, linked, memory, number, opened, run
from unifg.solvers.barrier_state import (
    ACCEPT,
    ACCEPTED,
    ADVANCE,
    AGAIN,
    ALPHA,
    ANSWER,
    BEGIN,
    CORRECT,
    COST,
    CURVE,
    DIRECT,
    EVALUATE,
    EXACT,
    FACTOR,
    JUDGE,
    LINEARIZE,
    LINKS,
    LOOP,
    MEASURE,
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
    problem, work = opened(address)
    alpha, free = work.numbers[ALPHA], problem.free
    for k in range(len(free)):
        work.move[k] = alpha * work.step[k]
    copy(work.values, work.trial)
    fill(work.spread, 0.0)
    run(problem.links[RETRACT], (problem.parts, free, work.move, work.spread, work.values, work.trial))
    work.numbers[TRIAL_COST] = number(
        problem.links[EVALUATE],
        (problem.terms, work.trial, work.trial_residual, work.trial_constraints, work.squares, problem.scratch),
    )


@linked
def loop(address: int) -> None:
    """Iterate from ``work.values``, which is moved, to one of the endings."""
    problem, work = opened(address)
    links, numbers, counts = problem.links, work.numbers, work.counts
    started = False
    while True:
        fill(work.gradient, 0.0)
        fill(work.hessian, 0.0)
        numbers[COST] = number(
            links[LINEARIZE],
            (
                problem.terms,
                work.values,
                False,
                work.residual,
                work.jacobian,
                work.constraints,
                work.constraint_jacobian,
                work.squares,
                work.norms,
                work.gradient,
                work.hessian,
                problem.scratch,
            ),
        )
        run(links[MEASURE if started else BEGIN], (address,))
        started = True
        run(links[TEST], (address,))
        if counts[EXACT] == 1 and counts[ANSWER] == TRY:
            copy(work.hessian, work.curvature)
            run(links[CURVE], (problem.terms, work.values, work.residual, work.multipliers, work.curvature))
        while counts[ANSWER] == TRY:
            run(links[DIRECT], (address,))
            while counts[ANSWER] == TRY:
                run(links[ADVANCE], (address,))
                run(links[JUDGE], (address,))
            if counts[ANSWER] == AGAIN:
                run(links[TEST], (address,))
        if counts[ANSWER] != ACCEPTED:
            return
        copy(work.trial, work.values)


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
        retract_parts, NOTHING, kinds["parts"], kinds["free"], vector, kinds["spread"], values, values
    )
    parts = {
        BEGIN: barrier.begin,
        MEASURE: barrier.measure,
        TEST: barrier.test,
        JUDGE: barrier.judge,
        CORRECT: barrier.correct,
        RESTORE: barrier.restore,
        ACCEPT: barrier.accept,
        DIRECT: barrier_direction.direct,
        STEER: barrier_direction.steer,
        ADVANCE: advance,
        LOOP: loop,
    }
    for place, function in parts.items():
        links[place] = link(function, NOTHING, ADDRESS)
    return links
