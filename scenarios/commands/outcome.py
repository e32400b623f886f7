"""How a run on the command line ended, and how it tells of its progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

__all__ = ["Outcome", "Progress"]

Progress: TypeAlias = Callable[[float, str], None]
"""Takes the share that is done, and a word about it; raises KeyboardInterrupt when the user wants to stop."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        succeeded: whether the robot did what it was asked.
        interrupted: whether the user stopped it.
        summary: table for people.
        write: writes the results into an existing folder and returns the files.
    """

    succeeded: bool
    interrupted: bool
    summary: str
    write: Callable[[Path], list[Path]]
