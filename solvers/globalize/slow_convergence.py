"""Slow convergence: detection of solves for which another model of the problem pays off."""

from __future__ import annotations

import math
from collections.abc import Sequence

from unifg.solution.history import Iteration
from unifg.solution.solve_state import SolveState

PATIENCE = 20  # iterations that any solve may take to get near
LOOK_BACK = 10  # iterations over which progress is judged
NEAR = 0.1  # largest KKT number: farther away second derivatives may lead to another optimum, or to none
FEW = 4  # rows of a history, from which on its last two iterations tell the rate
PROGRESS = 0.1  # of the error, that a sound linear convergence leaves after them: 0.8 per iteration


def converges_slowly(history: Sequence[Iteration]) -> bool:
    """Test whether the last iterations have left more than a tenth of what misses the KKT conditions."""
    if len(history) <= PATIENCE:
        return False
    return _missing(history[-1]) > PROGRESS * _missing(history[-1 - LOOK_BACK])


def second_derivatives_pay(run: SolveState, worth: float) -> bool:
    """Test whether a solve converges slowly, or has more than ``worth`` iterations to go where nothing is Python's."""
    left = 0.0 if run.program.batched else iterations_left(run.history, run.tolerances.kkt)
    return left > worth or converges_slowly(run.history)


def iterations_left(history: Sequence[Iteration], tolerance: float) -> float:
    """Iterations to the tolerance at the rate of the last two; 0 where these are not full steps that converge."""
    if len(history) < FEW or any(row.step_length < 1.0 for row in history[-2:]):
        return 0.0
    before, now = _missing(history[-3]), _missing(history[-1])
    return 2.0 * math.log(now / tolerance) / math.log(before / now) if tolerance < now < min(before, NEAR) else 0.0


def _missing(row: Iteration) -> float:
    return max(row.stationarity, row.violation, row.complementarity)
