"""Revocable factors: closures that count while the rest agrees, and are taken back when it does not.

The cost of a set of factors with a truncated loss, 1/2 sum of min(|W r|^2, c^2), decides (A. J. Yang, V. Tzoumas and L.
Carlone, "Graduated non-convexity for robust spatial perception", 2020, eq. 13): one that is left out costs c^2 / 2.
A new one is accepted if its innovation, normalised by the covariances of prediction and measurement, is within c^2. One
that counts is revoked where its residual is beyond c^2 at the estimates, and with those beside it where the rest would
cost less by more than c^2 each without them; it is accepted again where its residual is within. Two that agree with
each other, or belong together, and not with the rest are tried together, against those that contradict them. What is
tried is kept if the truncated cost has become less. Where some are revoked, the innovations of what was left out
because of them are looked at again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.errors import GraphError, require_positive
from unifg.smoothing.factors import Staged
from unifg.smoothing.queries import covariance_root, factor_rows, squared_errors
from unifg.smoothing.smoother import Smoother
from unifg.smoothing.state import STALE
from unifg.typing import Array, BoolArray, IntArray

LEAST = 1e-12  # weight of a factor that does not count
NEWEST = 8  # left out ones with which a new one is tried
PASSES = 3  # in each round of a trial
ROUNDS = 5
SHARE = 0.1  # of a disagreement that curvature may leave
WITHIN = 100.0  # limits: what is farther off is not looked at again
SINGULAR = 1e-9  # of one minus leverage
BESIDE = 10  # variables between the ends of factors that belong together, by the order in which they came
TOGETHER = 6
MANY = 20  # variables that were eliminated anew, after which old factors may have come to disagree


class Revocable(NamedTuple):
    """Revocable factor.

    Attributes:
        name: of its term.
        members: families and members it is about.
        accepted: whether it counts.
        squared: |W r|^2 at the estimates.
    """

    name: str
    members: tuple[tuple[str, int], ...]
    accepted: bool
    squared: float


class Revocables:
    """All revocable factors of a smoother.

    Attributes:
        rows: of each among the factors.
        accepted: whether each counts.
    """

    def __init__(self) -> None:
        """Know none."""
        self._labels: list[tuple[str, tuple[tuple[str, int], ...]]] = []
        self.rows = np.zeros(0, dtype=np.int64)
        self._limits, self.accepted = np.zeros(0), np.zeros(0, dtype=bool)
        self._group = np.zeros(0, dtype=np.int64)  # of each; those that belong together have one
        self._ends = np.zeros((0, 2), dtype=np.int64)  # first and last variable of the latest factor of each group
        self._hidden = np.zeros(0)  # times |W r|^2 of a group is at least what the rest would cost less without it
        self._settled = 0  # factors that have been judged at least once

    def __len__(self) -> int:
        """Number of factors."""
        return len(self.rows)

    def add(self, smoother: Smoother, item: Staged) -> None:
        """Take in staged factors that have just been added, which do not count yet."""
        state, count = smoother._state, len(item.data)
        row, rows = int(state.counters["new_factors"][0]), []
        for _ in range(count):
            rows.append(row)
            row = int(state.factors["next"][row])
        self.rows = np.append(self.rows, rows[::-1])
        self._limits = np.append(self._limits, np.full(count, item.limit))
        self.accepted = np.append(self.accepted, np.zeros(count, dtype=bool))
        for k in range(count):
            members = [
                (f.name, int(m[k if len(m) > 1 else 0])) for f, m in zip(item.families, item.members, strict=True)
            ]
            self._labels.append((item.name, tuple(members)))
            self._join(smoother, len(self._labels) - 1)

    def _join(self, smoother: Smoother, k: int) -> None:
        """Put a new factor into the latest group that is beside it, or a group of its own."""
        order = smoother._state.variables["sequence"][self._variables(smoother, k)]
        ends = order.min(), order.max()
        beside = (np.abs(self._ends - ends) <= BESIDE).all(axis=1)
        beside &= np.bincount(self._group, minlength=len(beside)) < TOGETHER
        number = int(np.flatnonzero(beside)[-1]) if beside.any() else len(beside)
        if number == len(beside):
            self._ends, self._hidden = np.vstack([self._ends, ends]), np.append(self._hidden, 0.0)
        self._ends[number], self._hidden[number] = ends, 1.0 / SINGULAR
        self._group = np.append(self._group, number)

    def _variables(self, smoother: Smoother, k: int) -> list[int]:
        """Rows of the variables of a factor."""
        state = smoother._state
        factor = state.factors[self.rows[k]]
        at, count = int(factor["variables"]), int(state.types[factor["type"]]["slots"])
        rows: list[int] = state.lists[at : at + count].tolist()
        return rows

    def listed(self, smoother: Smoother) -> list[Revocable]:
        """All of them, as they are now."""
        squared = self._squared(smoother)
        return [
            Revocable(*label, bool(accepted), float(error))
            for label, accepted, error in zip(self._labels, self.accepted, squared, strict=True)
        ]

    def settle(self, smoother: Smoother, several: bool) -> None:
        """Accept, revoke and try after an update of one or several passes."""
        before, first, self._settled = self.accepted.copy(), self._settled, len(self)
        for new in range(first, len(self)):
            if self._innovation(smoother, [new]) <= self._limits[new]:
                self.accepted[new] = True
        self._apply(smoother, before)
        counted = self.accepted.copy()
        if first == len(self) and not several and smoother._effort().eliminated < MANY:
            return
        self._revise(smoother)
        self._take_back(smoother)
        for new in np.flatnonzero(~self.accepted[first:]).tolist():
            self._try(smoother, first + new)
        if (counted & ~self.accepted).any():
            self._look_again(smoother)

    def _look_again(self, smoother: Smoother) -> None:
        """Accept what was left out because of others that have been revoked since."""
        out = ~self.accepted & (self._squared(smoother) <= WITHIN * self._limits)
        for k in np.flatnonzero(out).tolist():
            if self._innovation(smoother, [k]) <= self._limits[k]:
                before = self.accepted.copy()
                self.accepted[k] = True
                self._apply(smoother, before)

    def _revise(self, smoother: Smoother) -> None:
        """Accept what is within its limit, and revoke of those that are beyond the one that is farthest."""
        before, excess = self.accepted.copy(), self._squared(smoother) / self._limits
        self.accepted |= excess <= 1.0
        counted = np.where(before, excess, 0.0)
        if counted.max(initial=0.0) > 1.0:
            self.accepted[int(np.argmax(counted))] = False
        self._apply(smoother, before)

    def _take_back(self, smoother: Smoother) -> None:
        """Revoke what the rest contradicts, though it hides that: leverage keeps its own residual small."""
        for _ in range(ROUNDS):
            worst, excess, counts = list[int](), 1.0, self.accepted
            own, limits = (
                np.bincount(self._group, np.where(counts, each, 0.0))
                for each in (self._squared(smoother), self._limits)
            )
            for number in np.flatnonzero(own * self._hidden > limits).tolist():
                counting = np.flatnonzero(counts & (self._group == number)).tolist()
                less = self._deletion(smoother, number, counting)
                if less > excess * limits[number]:
                    worst, excess = counting, less / limits[number]
            if not worst:
                return
            wanted = counts.copy()
            wanted[worst] = False
            if not self._better(smoother, wanted, [], 1):
                return
            self._revise(smoother)  # of those that were revoked together, some may agree with the rest

    def _deletion(self, smoother: Smoother, number: int, counting: list[int]) -> float:
        """Decrease of |W r|^2 of all factors without some of a group, to first order.

        Their leverage is kept: factors that come later can only make it less.
        """
        error, spread = self._spread(smoother, counting, 1.0)
        leverages, axes = np.linalg.eigh(spread)
        left = np.maximum(1.0 - leverages, SINGULAR)
        self._hidden[number] = 1.0 / float(left.min())
        return float(((axes.T @ error) ** 2 / left).sum())

    def _try(self, smoother: Smoother, new: int) -> None:
        """Let a factor that disagrees count, with an earlier one that agrees with it, and keep what costs less."""
        alone, left_out = self._innovation(smoother, [new]), np.flatnonzero(~self.accepted[:new]).tolist()
        group = self._group == self._group[new]
        earlier = [k for k in left_out[-NEWEST:] if group[k] or self._explains(smoother, new, alone, k)]
        if not earlier:
            return
        wanted = self.accepted.copy()
        wanted[[*earlier, new]] = True
        self._better(smoother, wanted, [*earlier, new], ROUNDS)

    def _better(self, smoother: Smoother, wanted: BoolArray, tried: list[int], rounds: int) -> bool:
        """Let those that are wanted count, and what agrees with them then; all is as it was unless that costs less."""
        before, cost = self.accepted.copy(), self._cost(smoother)
        try:
            for number in range(rounds):
                last, self.accepted = self.accepted, wanted
                self._apply(smoother, last, PASSES)
                wanted = self._squared(smoother) <= self._limits
                wanted[tried] |= number == 0  # the others give way first
                if np.array_equal(wanted, self.accepted):
                    break
            better = self._cost(smoother) < cost
        except GraphError:  # too far to be solved
            better = False
        if not better:
            last, self.accepted = self.accepted, before
            self._apply(smoother, last, PASSES)
        return better

    def _explains(self, smoother: Smoother, new: int, alone: float, k: int) -> bool:
        """Test whether most of the disagreement of a factor would be gone if another one counted."""
        left = self._innovation(smoother, [new, k]) - alone
        return bool(left <= max(self._limits[k], SHARE * self._innovation(smoother, [k])))

    def _innovation(self, smoother: Smoother, which: list[int]) -> float:
        """Squared innovation e' S^-1 e of factors that do not count, S being the covariance of their residuals."""
        error, spread = self._spread(smoother, which, LEAST)
        return float(error @ np.linalg.solve(spread + np.eye(len(error)), error))

    def _spread(self, smoother: Smoother, which: list[int], weight: float) -> tuple[Array, Array]:
        """Whitened residuals (m,) of factors of a weight at the estimates, and J P J' (m, m)."""
        state, variables = smoother._state, list[int]()
        blocks = []
        for k in which:
            factor = state.factors[self.rows[k]]
            kind = state.types[factor["type"]]
            rows = np.empty((int(kind["rows"]), 1 + int(kind["width"])))
            factor_rows(smoother._memory, int(self.rows[k]), rows)
            blocks.append(rows / np.sqrt(weight))
            variables += self._variables(smoother, k)
        root = covariance_root(smoother._memory, np.array(variables))
        error = np.concatenate([block[:, 0] for block in blocks])
        slopes, row, column = np.zeros((len(error), root.shape[1])), 0, 0
        for block in blocks:
            height, width = len(block), block.shape[1] - 1
            slopes[row : row + height, column : column + width] = block[:, 1:]
            row, column = row + height, column + width
        spread = root @ slopes.T
        return error, spread.T @ spread

    def _squared(self, smoother: Smoother) -> Array:
        """(n,) |W r|^2 at the estimates."""
        squared = np.empty(len(self))
        squared_errors(smoother._memory, self.rows, squared)
        return np.where(self.accepted, squared, squared / LEAST)

    def _cost(self, smoother: Smoother) -> float:
        """Truncated cost at the estimates."""
        return smoother.cost + 0.5 * float(self._limits[~self.accepted].sum())

    def _apply(self, smoother: Smoother, before: Array, passes: int = 1) -> None:
        """Weigh those anew that have changed, and solve; nothing where none has."""
        changed: IntArray = np.flatnonzero(self.accepted != before)
        if not len(changed):
            return
        state = smoother._state
        for k in changed.tolist():
            row = int(self.rows[k])
            factor = state.factors[row]
            kind = state.types[factor["type"]]
            begin, end = (int(factor["data"] + kind[name]) for name in ("parameters", "numbers"))
            state.numbers[begin:end] *= LEAST ** (-0.5 if self.accepted[k] else 0.5)
            state.factors["state"][row] = STALE
            state.factors["next"][row] = state.counters["new_factors"][0]
            state.counters["new_factors"][0] = row
        for _ in range(passes):
            smoother._solve()


def limit_of(threshold: float, term: str) -> float:
    """Greatest |W r|^2 of a factor that counts.

    Raises:
        GraphError: the threshold is not a positive and finite number.
    """
    require_positive(f"term '{term}'", GraphError, revocable=threshold)
    return float(threshold) ** 2
