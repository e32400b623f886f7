"""The line search of all backends that shorten their steps: in full, corrected for curved constraints, then halved."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from unifg.problem.linearization import Linearization
from unifg.solvers.globalize.merit import Merit, Point
from unifg.typing import Array

SHORTEST = 1e-6


class Taken(NamedTuple):
    """A step that was accepted.

    Attributes:
        reached: linearisation at its end.
        step: (n,) as taken.
        length: share of the full step.
        dual: (M,) what came with a second-order correction; None where there was none.
    """

    reached: Linearization
    step: Array
    length: float
    dual: Array | None = None


def search(
    lin: Linearization,
    step: Array,
    merit: Merit,
    here: float,
    slope: float,
    slack: float,
    linear: Array | None = None,
    correct: Callable[[Array], tuple[Array, Array] | None] | None = None,
    *,
    eager: bool = False,
    shortest: float = SHORTEST,
) -> Taken | None:
    """Find how far to go along a step; None where no length helps.

    A residual may have an edge where its derivatives end: what cannot be linearised is not accepted.

    Args:
        lin: where.
        step: (n,) full step.
        merit: what it has to lower.
        here: merit at ``lin``.
        slope: its derivative along the step.
        slack: what counts as rounding.
        linear: (M,) A times the step, for corrections.
        correct: a second-order correction: the step, and what goes with it, for constraints that bend by (M,); None
            for none.
        eager: linearise the full step at once, where it is the rule; otherwise it is evaluated first.
        shortest: share of the step below which there is no use.
    """
    program = merit.program
    values = program.retract(lin.values, step)
    reached = program.linearize(values) if eager else None
    trial: Point = program.evaluate(values, lin.weights) if reached is None or program.table.holding else reached
    if merit.accepts(trial, here, slope, 1.0, slack):
        reached = program.linearize(values) if reached is None else reached
        if reached.finite:
            return Taken(reached, step, 1.0)
    if correct is not None and trial.finite and program.constraints.count:
        assert linear is not None
        corrected = correct(trial.constraints - lin.constraints - linear)
        if corrected is not None:
            values = program.retract(lin.values, corrected[0])
            if merit.accepts(program.evaluate(values, lin.weights), here, slope, 1.0, slack):
                reached = program.linearize(values)
                if reached.finite:
                    return Taken(reached, corrected[0], 1.0, corrected[1])
    length = 0.5
    while length >= shortest:
        values = program.retract(lin.values, length * step)
        if merit.accepts(program.evaluate(values, lin.weights), here, slope, length, slack):
            reached = program.linearize(values)
            if reached.finite:
                return Taken(reached, length * step, length)
        length *= 0.5
    return None
