"""The best iterates of a solve, for one that ends without success.

Iterates are compared by the l1 merit: the cost plus a price times the sum of all violations. The price is the largest
multiplier so far, the least for which the merit is exact (Nocedal and Wright, section 15.4). It only rises: an iterate
that violates more than the best one at the present price can never be the best again, and is forgotten.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.program.columns import Values
from unifg.typing import Array


class Incumbent(NamedTuple):
    """One iterate.

    Attributes:
        number: of its row in the history; 0 for the guess.
        cost, violation: objective, and sum of the violations of all rows.
        values, multipliers: the iterate.
    """

    number: int
    cost: float
    violation: float
    values: Values
    multipliers: Array


class Incumbents:
    """What may still be the best iterate, at the present price or a higher one.

    Attributes:
        price: of violation.
    """

    def __init__(self) -> None:
        """There is none yet."""
        self.price = 0.0
        self._kept: list[Incumbent] = []

    def __bool__(self) -> bool:
        """Whether there is one."""
        return bool(self._kept)

    def see(self, found: Incumbent) -> None:
        """Take note of an iterate, which takes the place of equals."""
        if len(found.multipliers):
            self.price = max(self.price, float(np.abs(found.multipliers).max()))
        self._kept = [k for k in self._kept if k.cost < found.cost or k.violation < found.violation]
        if not any(k.cost <= found.cost and k.violation <= found.violation for k in self._kept):
            self._kept.append(found)
        least = self.best.violation
        self._kept = [k for k in self._kept if k.violation <= least]

    @property
    def best(self) -> Incumbent:
        """The iterate of least merit, the last of equals."""
        return min(reversed(self._kept), key=lambda k: k.cost + self.price * k.violation)
