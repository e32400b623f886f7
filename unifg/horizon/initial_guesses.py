"""Initial guesses of solves that have no last answer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from unifg.errors import GraphError, require_kinds
from unifg.horizon.terms import Context
from unifg.solution.guess import Guess
from unifg.typing import Array


@dataclass(frozen=True)
class InitialGuesses:
    """Initial guesses of solves without a last answer.

    Attributes:
        cold: ``cold(now)`` gives states (N + 1, storage) and controls (N, m); None: stay, with the control zero.
        after_failure: the same after a solve whose plan was refused; None for ``cold``.
        carry: ``carry(guess, now)`` what of a shifted last answer still holds; None for all of it.
        others: ``others(now)`` more states and controls, for instance one pair for each side of an obstacle. They and
            the cold guess are tried where there is no last answer, and beside the warm start where data have jumped
            (:class:`unifg.horizon.multistart.Jumps`). Without any, ``lambda now: ()``, the cold guess alone is; None
            for one start in every tick.
    """

    cold: Callable[[Context[Any]], tuple[Array, Array]] | None = None
    after_failure: Callable[[Context[Any]], tuple[Array, Array]] | None = None
    carry: Callable[[Guess, Context[Any]], Guess] | None = None
    others: Callable[[Context[Any]], Iterable[tuple[Array, Array]]] | None = None

    def __post_init__(self) -> None:
        """Refuse what is no function before it is called."""
        require_kinds("InitialGuesses", GraphError, InitialGuesses.__annotations__, vars(self))
