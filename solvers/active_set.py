"""Primal-dual active sets: the rows of a linearised problem that hold as equalities.

A row is held at a limit while its multiplier pushes towards the inside, and enters where a step would leave the limit:
Newton's method on min(slack, multiplier) = 0 (M. Hintermueller, K. Ito, K. Kunisch, "The primal-dual active set
strategy as a semismooth Newton method", SIAM J. Optim. 13(3), 2002). All rows change at once, which takes a few systems
where it settles; where it does not, or meets a singular system, one row changes at a time, the first of those that are
wrong, which ends for strictly convex problems (K. G. Murty, "Note on a Bard-type scheme", Opsearch 11, 1974).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from unifg.problem.compiled_problem import CompiledProblem
from unifg.typing import Array, BoolArray, IntArray

ALL_AT_ONCE, ONE_BY_ONE = 15, 100  # systems
ROUNDING = 1e-12  # of multipliers, relative to the largest


class ActiveSet:
    """The rows that are held, from one linearised problem to the next.

    Attributes:
        choice: whether there is any inequality.
        side: (M,) 1 at the upper limit, as equalities are, -1 at the lower one, 0 for rows that are not held.
    """

    def __init__(self, program: CompiledProblem, choice: bool, multipliers: Array, tolerance: float) -> None:
        """Begin with the equalities, and the inequalities that have multipliers (M,).

        Args:
            program: the compiled graph, with its limits bound.
            choice: whether there is any inequality.
            multipliers: (M,) of the guess.
            tolerance: violation below which no row enters.
        """
        self._lower, self._upper, self._equality = program.lower, program.upper, program.equality
        self._tolerance, self._single = tolerance, False
        self.choice = choice
        side = np.sign(multipliers) * np.isfinite(np.where(multipliers > 0.0, program.upper, program.lower))
        self.side: IntArray = np.where(program.equality, 1, side).astype(np.intp)

    @property
    def held(self) -> BoolArray:
        """(M,) rows that are held."""
        held: BoolArray = self.side != 0
        return held

    def missing(self, constraints: Array) -> Array:
        """(M,) distance of held rows from their limits, zero for the others."""
        away = np.where(self.side > 0, self._upper, self._lower) - constraints
        return np.where(self.side == 0, 0.0, away)

    def attempts(self) -> Iterator[None]:
        """Sets to be tried, until one has settled; the one at the beginning is left where none has."""
        before = self.side
        for self._single, count in ((False, ALL_AT_ONCE), (True, ONE_BY_ONE)):
            self.side, self._failed = before, False
            for _ in range(count):
                yield
                if self._failed:
                    break
        self.side = before

    def fail(self) -> None:
        """Give up the present series of attempts: its system is singular."""
        self._failed = True

    def settled(self, constraints: Array, multipliers: Array) -> bool:
        """Test whether a solution of the system for this set solves the problem, and change the set otherwise.

        Args:
            constraints: (M,) by the linearisation at the end of the step.
            multipliers: (M,) there.
        """
        least = -ROUNDING * float(np.abs(multipliers).max(initial=0.0))
        side = np.where((self.side * multipliers < least) & ~self._equality, 0, self.side)
        side[(self.side == 0) & (constraints > self._upper + self._tolerance)] = 1
        side[(self.side == 0) & (constraints < self._lower - self._tolerance)] = -1
        wrong = np.flatnonzero(side != self.side)
        if self._single:
            side[wrong[1:]] = self.side[wrong[1:]]
        self.side = side
        return not len(wrong)
