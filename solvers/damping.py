"""Levenberg-Marquardt control of the damping by the gain ratio (Nielsen 1999)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from unifg.machine.jit import compiled
from unifg.program.columns import Values
from unifg.program.linearization import Linearization
from unifg.solvers.model import STRAIGHT, model_step
from unifg.solvers.primal import Primal
from unifg.typing import Array

SMALLEST = 1e-12
LARGEST = 1e12
SHRINK = 0.1
ROUNDING = 1e-14
SUFFICIENT = 1e-4
LEAST_SHARE = 0.125  # of the second derivatives, before they are left out
WELL = 0.75  # of the predicted decrease: a step that brings less is corrected
CORRECTIONS = 3  # at most, of one trial


@dataclass
class Damping:
    """Damping that grows after rejected steps and shrinks after good ones.

    Attributes:
        value: present damping, relative to the diagonal of the Hessian.
        growth: factor of the next rejection; doubles with each.
        share: of the second derivatives that left the last model convex.
        base: (M,) constraints where the step is zero, in the model of the step taken last.
    """

    value: float
    growth: float = 2.0
    share: float = 1.0
    base: Array = field(default_factory=lambda: STRAIGHT)

    def reject(self) -> None:
        """Grow, faster with every rejection in a row."""
        self.value = max(self.value, SMALLEST) * self.growth
        self.growth *= 2.0

    def accept(self, gain: float) -> None:
        """Shrink by how well the quadratic model predicted the decrease."""
        self.value = max(self.value * max(SHRINK, 1.0 - (2.0 * gain - 1.0) ** 3), SMALLEST)
        self.growth = 2.0


def damped_step(
    primal: Primal,
    lin: Linearization,
    multipliers: Array,
    penalty: Array,
    damping: Damping,
    bend: Array = STRAIGHT,
) -> tuple[Values, Array, int] | None:
    """One accepted step on the augmented objective.

    A step of length d along curved constraints leaves them by some d^2, which costs rho d^4: the larger rho, the
    shorter the steps that damping allows. So where second derivatives are in the model, a trial that brings much less
    than predicted is followed by second-order corrections (Nocedal and Wright, section 18.3): the same model, with the
    values of the constraints found there.

    Args:
        primal: the augmented objective and its factorisation.
        lin: where.
        multipliers: (M,) of the augmented objective.
        penalty: (M,) rho of every row.
        damping: what it begins with, and what it learns.
        bend: (nnz,) second derivatives for the model; a share of them, or none, where they leave it indefinite.

    Returns:
        The new values, the tangent step and the number of rejected trials; None when no damping helps.
    """
    merit = primal.merit(lin, multipliers, penalty)
    # Least squares has no unit: what is rounding depends on the cost alone.
    slack = ROUNDING * (merit if primal.program.least_squares else max(1.0, abs(merit)))
    rows = primal.program.constraints
    rejected, rounded = 0, False
    damping.share = share = min(4.0 * damping.share, 1.0)
    while damping.value <= LARGEST:
        curved = len(bend) > 0 and share > 0.0
        chosen = (bend if share == 1.0 else share * bend) if curved else STRAIGHT
        found = model_step(primal, lin, multipliers, penalty, damping.value, chosen)
        if found is None and curved:
            damping.share = max(0.5 * share, LEAST_SHARE)
            share = 0.5 * share if share > LEAST_SHARE else 0.0
            continue
        if found is not None:
            step, predicted = found
            values, evaluation = primal.trial(lin, step)
            actual = merit - primal.merit(evaluation, multipliers, penalty)
            if not rounded and not actual >= SUFFICIENT * predicted - slack:
                slack, rounded = max(slack, primal.rounding(lin, multipliers, penalty)), True
            base = lin.constraints
            for _ in range(CORRECTIONS if len(bend) > 0 else 0):
                if not evaluation.finite or actual >= WELL * predicted - slack:
                    break
                # What the rows are at the trial, continued along their tangents back to no step.
                curved_base = evaluation.constraints - rows.times(lin.constraint_jacobian, step)
                again = model_step(primal, lin, multipliers, penalty, damping.value, chosen, curved_base)
                if again is None:
                    break
                moved, there = primal.trial(lin, again[0])
                better = merit - primal.merit(there, multipliers, penalty)
                if not (there.finite and better > actual):
                    break
                base, step, values, evaluation, actual = curved_base, again[0], moved, there, better
            if evaluation.finite and actual >= SUFFICIENT * predicted - slack:
                damping.accept(1.0 if predicted <= slack else min(actual / predicted, 1.0))
                damping.base = base
                return values, step, rejected
        rejected += 1
        damping.reject()
    damping.value = LARGEST
    return None


def norm(step: Array) -> float:
    """Euclidean norm, without waking the threads of a BLAS, and of steps whose squares overflow too."""
    squares = _squares(step)
    if 1e-200 < squares < 1e200:
        return math.sqrt(squares)
    size = largest(step)
    return size if not 0.0 < size < np.inf else size * math.sqrt(_squares(step / size))


def largest(vector: Array) -> float:
    """Infinity norm."""
    return float(_largest(vector))


@compiled
def _squares(vector: Array) -> float:
    total = 0.0
    for number in vector:
        total += number * number
    return total


@compiled
def _largest(vector: Array) -> float:
    result = 0.0
    for number in vector:
        if number != number:
            return np.nan
        result = max(result, abs(number))
    return result
