"""A user's batched function at the points of many moves, in few calls where it allows that.

A residual treats its factors one by one, so the factors of many perturbed batches may stand in one long batch: what
small arrays cost is the call. But a function may know the length of its batch: by arrays of its own with a row per
factor, by the index of a factor. So it is first called both ways at points that differ from batch to batch. Where the
long call fails, or returns other numbers, there is one call for each batch for good.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from unifg.moves import Moves, Near, Steps
from unifg.typing import Array

logger = logging.getLogger("unifg")
LONGEST = 1 << 16  # numbers in the points of one call, which should fit into a cache with all that becomes of them
ALIKE = 1e-12  # relative difference that another order of summation may make


class Stack:
    """A batched function of all arguments, and those that are constants.

    Attributes:
        name: of the term, for messages.
    """

    def __init__(self, name: str, function: Callable[[list[Any]], Array]) -> None:
        """Take a function of the list of its arguments."""
        self.name, self._function = name, function
        self._arguments: list[Any] = []
        self._places: list[int] = []
        self._each: list[int] = []
        self._long: bool | None = None  # whether it takes long batches; None before it was tried
        self._tiled: dict[tuple[int, int], Array] = {}

    def bind(self, arguments: list[Any], places: list[int], each: list[int]) -> None:
        """Take constants, where variables stand among them, and which of them have a row for each factor."""
        self._arguments, self._places = arguments, places
        self._tiled.clear()
        if self._long is None:
            self._each = each

    def __call__(self, near: Near, steps: Steps, moves: Moves) -> Array:
        """(K, n, ...) what the function returns after each of K moves."""
        if self._long is None:
            self._long = self._takes_long_batches(near, steps)
        count = len(near.joined)
        length = max(1, LONGEST // (count * near.directions.storage)) if self._long else 1
        results: list[Array] = []
        at = 0
        while at < moves.count:
            last = min(at + length, moves.count)
            points = near.moved(steps, moves, at, last)
            if last - at == 1:
                results.append(self._single(points, 0)[None])
            else:
                found = self._batch(points)
                if found is None:  # one by one it works, or fails as it would have alone
                    logger.info("the residual '%s' does not take long batches", self.name)
                    self._long, length = False, 1
                    continue
                results.append(found)
            at = last
        return results[0] if len(results) == 1 else np.concatenate(results)

    def _single(self, points: list[Array], k: int) -> Array:
        """(n, ...) after one move."""
        arguments = list(self._arguments)
        for place, stack in zip(self._places, points, strict=True):
            arguments[place] = stack[k]
        return np.array(self._function(arguments))

    def _batch(self, points: list[Array]) -> Array | None:
        """(k, n, ...) results of one call; None where it fails, or returns another shape."""
        k, count = points[0].shape[:2]
        arguments = list(self._arguments)
        for place in self._each:
            if (place, k) not in self._tiled:
                given = arguments[place]
                self._tiled[place, k] = np.tile(given, (k,) + (1,) * (given.ndim - 1))
            arguments[place] = self._tiled[place, k]
        for place, stack in zip(self._places, points, strict=True):
            arguments[place] = stack.reshape(k * count, stack.shape[2])
        try:
            found = np.array(self._function(arguments))
        except Exception:
            return None
        return found.reshape(k, count, *found.shape[1:]) if found.shape[:1] == (k * count,) else None

    def _takes_long_batches(self, near: Near, steps: Steps) -> bool | None:
        """Call it both ways; None where it returns no numbers to compare.

        Arrays as long as the batch may or may not have a row for each factor: both is tried.
        """
        with np.errstate(all="ignore"):
            points = near.moved(steps, near.directions.anywhere, 0, near.directions.anywhere.count)
            alone = np.stack([self._single(points, k) for k in range(len(points[0]))])
            if not np.isfinite(alone).any():
                return None
            size = _largest(alone) + _largest(near.joined)
            each = self._each
            for rows in (each + self._perhaps(len(near.joined)), each):
                self._each = rows
                self._tiled.clear()
                found = self._batch(points)
                if found is not None and found.shape == alone.shape:
                    if np.allclose(found, alone, rtol=0.0, atol=ALIKE * size, equal_nan=True):
                        return True
        return False

    def _perhaps(self, count: int) -> list[int]:
        known = {*self._places, *self._each}
        return [
            k
            for k, given in enumerate(self._arguments)
            if k not in known and isinstance(given, np.ndarray) and given.ndim and len(given) == count > 1
        ]


def _largest(numbers: Array) -> float:
    return float(np.abs(numbers[np.isfinite(numbers)]).max(initial=0.0))
