"""Slow convergence: detection of solves for which another model of the problem pays off."""

from __future__ import annotations

from collections.abc import Sequence

from unifg.solution.history import Iteration

PATIENCE = 20  # iterations that any solve may take to get near
LOOK_BACK = 10  # iterations over which progress is judged
PROGRESS = 0.1  # of the error, that a sound linear convergence leaves after them: 0.8 per iteration


def converges_slowly(history: Sequence[Iteration]) -> bool:
    """Test whether the last iterations have left more than a tenth of what misses the KKT conditions."""
    if len(history) <= PATIENCE:
        return False
    return _missing(history[-1]) > PROGRESS * _missing(history[-1 - LOOK_BACK])


def _missing(row: Iteration) -> float:
    return max(row.stationarity, row.violation, row.complementarity)
