"""A user's batched function: what it returns is looked at, and many moves take few calls where it allows that.

A residual treats its factors one by one, so the factors of many perturbed batches may stand in one long batch: what
small arrays cost is the call. But a function may know the length of its batch: by arrays of its own with a row per
factor, by the index of a factor. So it is first called both ways at points that differ from batch to batch. Where the
long call fails, or returns other numbers, there is one call for each batch for good.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import numpy as np

from unifg.errors import GraphError, name_term
from unifg.factors.differences import Moves, Near, Steps
from unifg.typing import Array

logger = logging.getLogger("unifg")
LONGEST = 1 << 15  # numbers in the points of one call, which should fit into a cache with all that becomes of them
SHORTEST = 4  # batches in a call that are worth it
LOOKED_AT = 1000  # factors, one by one, after a function has raised
FLOAT64 = np.dtype(np.float64)
ALIKE = 1e-12  # relative difference that another order of summation may make


class Batched:
    """A batched function of variables and constants.

    Attributes:
        name: of the term, for messages.
        function: takes all arguments, returns (n, ...) doubles.
    """

    def __init__(self, name: str, function: Callable[..., Array]) -> None:
        """Constants come with :meth:`bind`."""
        self.name, self.function = name, function
        self._arguments: list[Any] = []
        self._places: list[int] = []
        self._each: list[int] = []
        self._long: bool | None = None  # whether it takes long batches; None before it was tried
        self._memory = np.empty(0)  # for results of many calls: fresh memory of that size costs more than they do
        self._tiled: dict[tuple[int, int], Array] = {}

    def bind(self, arguments: list[Any], places: list[int], each: list[int], alone: bool = False) -> None:
        """Take constants, and say which of them have a row for each factor.

        Args:
            arguments: of the function; anything in the places of variables.
            places: of the variables.
            each: places of constants with a row for each factor.
            alone: whether it is not known of another constant, so that there must be a call for each move.
        """
        self._arguments, self._places, self._each = arguments, places, each
        self._tiled.clear()
        self._long = False if alone else self._long

    def forget(self) -> None:
        """Constants have changed in place."""
        self._tiled.clear()

    def fill(self, points: Sequence[Array]) -> list[Any]:
        """All arguments in order, variables at these points."""
        arguments = list(self._arguments)
        for place, point in zip(self._places, points, strict=True):
            arguments[place] = point
        return arguments

    def at(self, points: Sequence[Array]) -> Array:
        """(n, ...) what the function returns, variables at these points.

        Raises:
            GraphError: when it is not made of doubles; of coarser numbers differences are noise. Errors of the function
                name the term.
        """
        return self._vetted(self.fill(points))

    def culprit(self, points: Sequence[Array], count: int) -> int | None:
        """The first of many factors for which the function raises by itself; None where it raises for none of them."""
        for factor in range(min(count, LOOKED_AT)):
            one = [point if len(point) == 1 else point[factor : factor + 1] for point in points]
            arguments = self.fill(one)
            for place in self._each:
                arguments[place] = arguments[place][factor : factor + 1]
            try:
                self.function(*arguments)
            except Exception:
                return factor
        return None

    def require_clean(self, points: Sequence[Array]) -> None:
        """Call the function once, and refuse one that changes its arguments.

        Raises:
            GraphError: naming the term and the argument.
        """
        arguments = [np.array(a) if isinstance(a, np.ndarray) else a for a in self.fill(points)]
        before = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
        self.function(*arguments)
        for place, (given, kept) in enumerate(zip(arguments, before, strict=True)):
            if isinstance(given, np.ndarray) and given.tobytes() != kept.tobytes():
                raise GraphError(changes(self.name, place), term=self.name)

    def on_copies(self, points: Sequence[Array]) -> Array:
        """The same as :meth:`at`, of a function that may write into what it is given."""
        return self._vetted([a.copy() if isinstance(a, np.ndarray) else a for a in self.fill(points)])

    def _vetted(self, arguments: list[Any]) -> Array:
        try:
            result = self.function(*arguments)
        except Exception as error:
            name_term(error, self.name)
            raise
        array = result if isinstance(result, np.ndarray) else self._as_array(result)
        if array.dtype != FLOAT64:
            raise GraphError(
                f"term '{self.name}': its function returned {array.dtype}, expected float64: differences of anything "
                "else are noise; convert its inputs, not its result",
                term=self.name,
            )
        return array

    def _as_array(self, result: Any) -> Array:
        """Array of a returned value.

        Raises:
            GraphError: it cannot become one.
        """
        if result is None:
            raise GraphError(f"term '{self.name}': its function returned None: is there no return?", term=self.name)
        try:
            return np.asarray(result)
        except ValueError as error:
            raise GraphError(
                f"term '{self.name}': its function returned a {type(result).__name__} that is no array: {error}",
                term=self.name,
            ) from error

    def __call__(self, near: Near, steps: Steps, moves: Moves) -> Array:
        """(K, n, ...) what the function returns after each of K moves, until it is called again."""
        if self._long is None:
            self._long = self._takes_long_batches(near, steps)
        count = len(near.joined)
        length = max(1, LONGEST // (count * near.directions.storage)) if self._long else 1
        if length < SHORTEST:
            return self._one_by_one(near, steps, moves)
        results: list[Array] = []
        for at in range(0, moves.count, length):
            found = self._batch(near.moved(steps, moves, at, min(at + length, moves.count)))
            if found is None:  # one by one it works, or fails as it would have alone
                logger.info("the residual '%s' does not take long batches", self.name)
                self._long = False
                return self._one_by_one(near, steps, moves)
            results.append(found)
        return results[0] if len(results) == 1 else np.concatenate(results)

    def _one_by_one(self, near: Near, steps: Steps, moves: Moves) -> Array:
        """The same, a call for each move."""
        results = np.empty(0)
        for k in range(moves.count):
            found = self.at(near.after(steps, moves, k))
            if k == 0:
                shape = moves.count, *np.shape(found)
                if self._memory.size < prod(shape):
                    self._memory = np.empty(prod(shape))
                results = self._memory[: prod(shape)].reshape(shape)
            results[k] = found
        return results

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
            found = np.array(self._vetted(arguments))
        except Exception:
            return None
        return found.reshape(k, count, *found.shape[1:]) if found.shape[:1] == (k * count,) else None

    def _takes_long_batches(self, near: Near, steps: Steps) -> bool | None:
        """Call it both ways; None where there are no numbers to compare."""
        with np.errstate(all="ignore"):
            anywhere = near.directions.anywhere
            points = near.moved(steps, anywhere, 0, anywhere.count)
            try:
                alone = np.stack([np.array(self.at([part[k] for part in points])) for k in range(anywhere.count)])
            except Exception:  # it refuses these points: nobody asked for them but this
                return None
            if not np.isfinite(alone).any():
                return None
            size = _largest(alone) + _largest(near.joined)
            self._tiled.clear()
            found = self._batch(points)
            if found is None or found.shape != alone.shape:
                return False
            return bool(np.allclose(found, alone, rtol=0.0, atol=ALIKE * size, equal_nan=True))


def changes(name: str, place: int) -> str:
    """Message about a function that writes to its arguments."""
    return f"term '{name}': its function changes its argument {place}, which belongs to the solver: work on a copy"


def _largest(numbers: Array) -> float:
    return float(np.abs(numbers[np.isfinite(numbers)]).max(initial=0.0))
