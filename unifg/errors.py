"""Exceptions: what was found, where it was found, and what to do about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from unifg.solution import Solution


class UnifgError(ValueError):
    """Base of every error raised by unifg."""


class GraphError(UnifgError):
    """The graph, its guess or its data cannot be solved as given.

    Attributes:
        term: name of the term concerned, if any.
        family: name of the variable family concerned, if any.
        index: position within the family or the term, if any.
    """

    def __init__(
        self,
        message: str,
        *,
        term: str | None = None,
        family: str | None = None,
        index: int | None = None,
    ) -> None:
        """Store the message and the place it speaks about."""
        super().__init__(message)
        self.term = term
        self.family = family
        self.index = index


class BackendError(UnifgError):
    """The chosen backend cannot take this class of problem, or is not installed."""


class ScenarioError(UnifgError):
    """A scenario was asked for something its world cannot offer."""


class FileFormatError(UnifgError):
    """A file does not say what its format promises."""


class NotConverged(RuntimeError):
    """Raised by ``solve(..., check=True)``; carries the solution that fell short.

    Attributes:
        solution: the last iterate, with its status and KKT numbers.
    """

    def __init__(self, solution: Solution) -> None:
        """Keep the solution and repeat its report as the message."""
        super().__init__(solution.report())
        self.solution = solution
