"""The past: a sliding window, what leaves it as a prior, and how a horizon is tied to it.

A graph of the future alone is given its present; in one graph of both the past's terms stand on the first state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import numpy as np

import unifg as fg
from unifg.errors import ScenarioError
from unifg.scenarios.horizon.part import Given, Gives, Now, known_present
from unifg.typing import Array


class Window:
    """The last L states, oldest first, then the present one, in arrays whose first axis runs over them.

    Attributes:
        length: number L of past states.
        entered: how many of them are there; the oldest places are empty until all are.
        arrival: reference and information of the prior that stands for what has left, on the oldest state.
        departure: what ``arrival`` becomes when the oldest state leaves.
    """

    arrival: tuple[Array, Array]
    departure: tuple[Array, Array]

    def __init__(self, length: int, entered: int = 0) -> None:
        """Begin with the present, and ``entered`` states before it.

        Raises:
            ScenarioError: when the window is shorter than two states.
        """
        if length < 2:
            raise ScenarioError(f"a window needs at least two past states, found {length}")
        self.length, self.entered = length, entered

    @property
    def full(self) -> bool:
        """Whether the next move drops the oldest state."""
        return self.entered == self.length

    @property
    def empty(self) -> int:
        """Places that no state has entered yet; the index of the oldest state."""
        return self.length - self.entered

    def shift(self, *arrays: Any) -> None:
        """Let the present become the past: move all rows of some arrays one place towards the oldest."""
        if self.full:
            self.arrival = self.departure
        else:
            self.entered += 1
        for array in arrays:
            array[:-1] = array[1:]


Tied = TypeVar("Tied", bound=Now, contravariant=True)


class Past(Protocol[Tied]):
    """A part that ties the first state to what is known of it, and takes from the solution what that says."""

    def state(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> Callable[[Tied], Given]:
        """Add the terms; returns what gives their data."""
        ...

    def begin(self, guess: fg.Guess, now: Tied) -> fg.Guess:
        """The guess for a solve, from one for the horizon alone."""
        ...

    def take(self, solution: fg.Solution, now: Tied, source: str) -> None:
        """Believe what a solution says of the past, if it says anything; ``source`` tells what came of its plan."""
        ...


class GivenPast:
    """A graph of the future alone."""

    def state(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[Now]:
        """Fix the first state."""
        return known_present(graph, x, u)

    def begin(self, guess: fg.Guess, now: Now) -> fg.Guess:
        """The guess as it is."""
        return guess

    def take(self, solution: fg.Solution, now: Now, source: str) -> None:
        """Leave the past to itself."""


def joined(guess: fg.Guess, x: fg.Family, present: Array, past: dict[fg.Family, Array]) -> fg.Guess:
    """A guess for past and future: the horizon's, but that it begins at the present (storage,), and the past's.

    A shifted plan begins where the last tick expected the robot; its first state gives way to what is known now.
    """
    values = {**guess.values, **past}
    values[x] = np.concatenate([present[None], np.asarray(guess.values[x])[1:]])
    return fg.Guess(values, guess.multipliers, guess.penalties)
