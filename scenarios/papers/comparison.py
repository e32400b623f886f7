"""Lines of a comparison with a paper: what it prints, what was computed, their difference and an interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from unifg.scenarios.campaigns.comparison import interval, share
from unifg.scenarios.campaigns.markdown import table
from unifg.scenarios.episode import Progress
from unifg.typing import Array

__all__ = ["Comparison", "Effort", "Line", "counted", "measured", "paired", "stated"]

NONE = "-"
_AGREES = {True: "agrees", False: "differs"}


@dataclass(frozen=True)
class Effort:
    """Size of a reproduction.

    Attributes:
        quick: a few runs, within five minutes; otherwise as many as on the page of results.
        folder: for files of drives, which are not repeated.
        workers: processes of campaigns.
        progress: told the share done and a short text.
    """

    quick: bool
    folder: Path
    workers: int
    progress: Progress

    def of(self, few: int, many: int) -> int:
        """Number of runs."""
        return few if self.quick else many


@dataclass(frozen=True)
class Line:
    """Quantity of a paper.

    Attributes:
        what: its name and unit.
        paper: as printed.
        ours: as computed.
        difference: of ours from the paper's; for a statement "agrees", "differs", or "undecided" by the interval.
        interval: 95 % confidence interval of ours.
    """

    what: str
    paper: str
    ours: str
    difference: str
    interval: str = NONE


@dataclass(frozen=True)
class Comparison:
    """Lines of one table or figure.

    Attributes:
        lines: one for each quantity.
        runs: sentence about what was run, and how often.
    """

    lines: Sequence[Line]
    runs: str

    def __str__(self) -> str:
        """Table as Markdown, and the sentence."""
        rows = [(line.what, line.paper, line.ours, line.difference, line.interval) for line in self.lines]
        return f"{table(('quantity', 'paper', 'ours', 'difference', '95 % interval'), rows)}\n\n{self.runs}"


def measured(
    what: str, printed: Sequence[float], values: ArrayLike, places: int = 2, deviation: float | None = None
) -> Line:
    """Mean of values beside a printed number, or beside the nearer end of a printed range.

    Args:
        what: name and unit.
        printed: a number, the two ends of a range, or nothing.
        values: (n,) of ours; those that are not finite do not count, and how many do is shown.
        places: decimals.
        deviation: printed standard deviation; ours is shown, too.
    """
    given = np.asarray(values, dtype=np.float64)
    found = given[np.isfinite(given)]
    paper = " to ".join(dict.fromkeys(f"{number:.10g}" for number in printed)) or NONE
    if not len(found):
        return Line(what, paper, NONE, NONE)
    mean, apart = float(found.mean()), NONE
    ours = f"{mean:.{places}f}"
    if printed:
        apart = f"{mean - min(max(mean, printed[0]), printed[-1]):+.{places}f}"
    if deviation is not None:
        paper = f"{paper} ± {deviation:g}"
        ours += f" ± {found.std(ddof=1):.{places}f}" if len(found) > 1 else ""
    ours += f" ({len(found)} of {len(given)})" if len(found) < len(given) else ""
    ends = " to ".join(f"{end:.{places}f}" for end in interval(found)) if len(found) > 1 else NONE
    return Line(what, paper, ours, apart, ends)


def counted(what: str, text: str, hits: int, of: int, least: float = 1.0) -> Line:
    """Share of runs in which a statement of a paper holds, with Wilson's interval.

    Args:
        what: the statement.
        text: as printed.
        hits: runs in which it holds.
        of: all runs.
        least: share from which on the statement holds; 1.0 asks for every run.
    """
    low, high = share(hits, of)
    holds = _holds(low, high, least) if least < 1.0 else _AGREES[hits == of]
    return Line(what, text, f"{hits} of {of}", holds, f"{100.0 * low:.0f} to {100.0 * high:.0f} %")


def paired(what: str, text: str, differences: Array, sign: float, places: int = 2) -> Line:
    """Mean of paired differences beside a statement about their sign.

    Args:
        what: name and unit.
        text: as printed.
        differences: (n,), one for each pair.
        sign: 1.0 where the statement wants a positive mean, -1.0 for a negative one.
        places: decimals.
    """
    shown = measured(what, [], differences, places)
    low, high = sorted(sign * end for end in interval(differences))
    return Line(what, text, shown.ours, _holds(low, high, 0.0), shown.interval)


def stated(what: str, text: str, ours: str, holds: bool, ends: str = NONE) -> Line:
    """Statement of a paper without a number, and whether it holds."""
    return Line(what, text, ours, _AGREES[holds], ends)


def _holds(low: float, high: float, least: float) -> str:
    """Word for a statement that a quantity exceeds a number, by the interval of the quantity."""
    return "undecided" if low <= least <= high else _AGREES[low > least]
