"""Outcome and progress of a run on the command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unifg.scenarios.episode import Progress
from unifg.solution.history import Iteration

__all__ = ["Outcome", "Progress", "by_iterations"]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run.

    Attributes:
        succeeded: whether the robot did what it was asked.
        interrupted: whether the user stopped it.
        summary: table for people.
        metrics: numbers and words for programs, as ``metrics.json`` holds them.
        write: writes the results into an existing folder and returns the files.
    """

    succeeded: bool
    interrupted: bool
    summary: str
    metrics: Mapping[str, Any]
    write: Callable[[Path], list[Path]]


def by_iterations(progress: Progress, pace: float, say: Callable[[Iteration], str]) -> Callable[[Iteration], None]:
    """A callback of a solver that tells of its progress.

    Args:
        progress: to be told.
        pace: share of the remainder that each iteration leaves, as their number is unknown.
        say: the word about an iteration.
    """

    def tell(row: Iteration) -> None:
        progress(1.0 - pace**row.number, say(row))

    return tell
