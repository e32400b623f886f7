"""Several starts of one solve: the cheapest feasible answer, and the ticks at which more than one is worth its time.

A warm start stays on the side of an obstacle on which the last plan passed it. After the goal has moved, that side may
be the wrong one, and a local method does not leave it (a multistart method; J. Nocedal and S. Wright, "Numerical
Optimization", 2006, section 1). In ordinary ticks the warm start is the best one, and nothing else is tried.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from unifg.errors import GraphError
from unifg.modeling.variables import Data
from unifg.solution.solution import AnyGuess, Solution
from unifg.solution.solver import Prepared
from unifg.typing import ArrayLike, Numbers

FEASIBLE = 1e-4  # violation of an answer that counts as a plan
LEAST_TIME = 1e-4  # [s] a solver is given however late it is
FAR = 5.0  # times its usual change, from which on a change of data is a jump
FADES = 0.5  # share of the usual change that is left after a tick without any
NOTICED = 0.05  # share of the last cost by which a jump changes that of the guess or of the answer, to be worth it


def cheapest(
    run: Prepared,
    starts: Iterable[AnyGuess],
    *,
    data: Mapping[Data, Numbers] | None = None,
    seconds: float = np.inf,
    incumbent: Solution | None = None,
    feasible: float = FEASIBLE,
    clock: Callable[[], float] = time.perf_counter,
) -> Solution:
    """Solve from several starts while there is time; return the feasible answer of least cost.

    Args:
        run: the prepared backend.
        starts: guesses, the best one first; taken one by one, so that a generator makes no more than are solved.
        data: of these solves.
        seconds: for all of them together. No solve begins later, and the solver gets what is left. The first start is
            always solved, unless there is an incumbent.
        incumbent: an answer for the same data that is there already, such as that of the warm start.
        feasible: greatest violation of an answer that counts. Without any, the least violation wins.
        clock: seconds of the wall.

    Raises:
        GraphError: without a start and an incumbent.
    """
    best, remaining, limit, end = incumbent, iter(starts), run.solver.time_limit, clock() + seconds
    try:
        while best is None or clock() < end:
            start = next(remaining, None)
            if start is None:
                break
            run.solver.time_limit = min(limit, max(LEAST_TIME, end - clock()))
            found = run.solve(start, data=data)
            if best is None or _rank(found, feasible) < _rank(best, feasible):
                best = found
    finally:
        run.solver.time_limit = limit
    if best is None:
        raise GraphError("there is no start to solve from")
    return best


def _rank(solution: Solution, feasible: float) -> tuple[bool, float]:
    """Order of answers: feasible ones by cost, then the others by violation."""
    if solution.violation <= feasible:
        return False, solution.cost
    return True, solution.violation


class Jumps:
    """Detection of ticks at which a goal, a reference or an obstacle has moved far against what it did before.

    A number of the data jumps when it changes by far more than is usual for its array, as that of a fixed goal does
    with any change, and that of a reference that moves on at a constant speed does not. A jump is worth more starts
    when the cost of the guess or of the answer differs from the last one, so that data without consequences pass.
    """

    def __init__(self) -> None:
        """Begin without a past."""
        self.clear()

    def clear(self) -> None:
        """Forget the data of earlier ticks."""
        self._flat, self._usual, self._starts = np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.intp)

    def __call__(self, data: Mapping[Data, ArrayLike], solution: Solution, last: Solution | None) -> bool:
        """Test whether a tick is worth more starts, and remember its data.

        Args:
            data: that the terms gave.
            solution: from the warm start.
            last: of the tick before; None for none.
        """
        flat = np.concatenate([*data.values()], axis=None, dtype=np.float64) if data else np.zeros(0)
        before, self._flat = self._flat, flat
        if len(before) != len(flat):
            sizes = [size for size in map(np.size, data.values()) if size]
            self._starts, self._usual = np.cumsum([0, *sizes[:-1]]), np.full(len(sizes), np.inf)
            return False
        usual, faded = self._usual, np.where(np.isfinite(self._usual), FADES * self._usual, 0.0)
        if np.array_equal(flat, before):
            self._usual = faded
            return False
        apart = np.subtract(flat, before, out=np.zeros(len(flat)), where=flat != before)  # infinite ones stay alike
        change = np.maximum.reduceat(np.abs(apart), self._starts)
        self._usual = np.maximum(change, faded)
        if last is None or not (change > FAR * usual).any():
            return False
        costs = solution.cost, solution.history[0].cost
        return any(abs(cost - last.cost) > NOTICED * abs(last.cost) for cost in costs)
