"""The best iterates of a solve, for one that ends without success.

Iterates are compared by the l1 merit: the cost plus a price times the sum of all violations. The price is the largest
multiplier so far, the least for which the merit is exact (Nocedal and Wright, section 15.4). It only rises: an iterate
that violates more than the best one at the present price can never be the best again, and is forgotten. Violations
within the tolerance have the price of their own iterate, which stays: what is feasible as stated is judged by its cost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.problem.compiled_problem import CompiledProblem
from unifg.typing import Array

MANY = 16  # iterates that wait until somebody compares them


class Incumbent(NamedTuple):
    """One iterate.

    Attributes:
        number: of its row in the history; 0 for the guess.
        cost: objective.
        constraints: (M,).
        values: stored ones, of all families.
        multipliers: (M,).
    """

    number: int
    cost: float
    constraints: Array
    values: Array
    multipliers: Array


class Incumbents:
    """Candidates for the best iterate, at the present penalty parameter or a higher one.

    Attributes:
        price: of violation, of the iterates that were compared.
    """

    def __init__(self, program: CompiledProblem, tolerance: float) -> None:
        """There is none yet; ``tolerance`` is that of the violation."""
        self._program, self._tolerance = program, tolerance
        self.price = 0.0
        self._kept: list[tuple[float, float, Incumbent]] = []  # with its violation, and its merit apart from that
        self._waiting: list[Incumbent] = []

    def __bool__(self) -> bool:
        """Test whether there is one."""
        return bool(self._kept or self._waiting)

    def see(self, found: Incumbent) -> None:
        """Take note of an iterate, which costs nothing until iterates are compared."""
        self._waiting.append(found)
        if len(self._waiting) > MANY:
            self._compare()

    @property
    def best(self) -> Incumbent:
        """The iterate of least merit, the last of equals."""
        self._compare()
        return min(reversed(self._kept), key=self._merit)[2]

    def _compare(self) -> None:
        for found in self._waiting:
            own = float(np.abs(found.multipliers).max(initial=0.0))
            self.price = max(self.price, own)
            outside = np.abs(self._program.violation(found.constraints))
            small = outside <= self._tolerance
            merit = found.cost + own * float(outside[small].sum())
            self._kept.append((float(outside[~small].sum()), merit, found))
        self._waiting = []
        if self._kept:
            best = min(reversed(self._kept), key=self._merit)
            self._kept = [*(kept for kept in self._kept if kept[0] < best[0]), best]

    def _merit(self, kept: tuple[float, float, Incumbent]) -> float:
        return kept[1] + self.price * kept[0]
