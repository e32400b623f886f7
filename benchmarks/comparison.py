"""Rows of a measurement by variant, and paired differences over the seeds that variants share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from itertools import starmap
from typing import Any, TypeAlias

import numpy as np

from unifg.scenarios.campaigns.comparison import digits as digits
from unifg.scenarios.campaigns.comparison import interval as interval
from unifg.scenarios.campaigns.comparison import share as share
from unifg.scenarios.campaigns.markdown import table
from unifg.typing import Array

Key: TypeAlias = tuple[Any, ...]
Row: TypeAlias = dict[str, Any]
Read: TypeAlias = Callable[[Row], float | None]
"""A measure of a row; None where it has none."""


def where(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Rows with these values, without those that were refused."""
    return [row for row in rows if "refused" not in row and all(row[name] == value for name, value in wanted.items())]


def grouped(rows: Iterable[Row], *names: str) -> dict[Key, list[Row]]:
    """Rows by the values of some names, in the order in which these come."""
    groups: dict[Key, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def paired(mine: Iterable[Row], base: Iterable[Row], read: Read) -> tuple[Array, Array]:
    """(n,) values of two variants for the seeds of which both have one."""
    a, b = ({row["seed"]: read(row) for row in rows} for rows in (mine, base))
    both = [(a[seed], b[seed]) for seed in sorted(set(a) & set(b)) if a[seed] is not None and b[seed] is not None]
    values = np.array(both, dtype=np.float64).reshape(-1, 2)
    return values[:, 0], values[:, 1]


def against(mine: Sequence[Row], base: Sequence[Row], read: Read) -> str:
    """Mean of a variant and, in brackets, the interval of its paired difference to the base, which has none.

    The number of pairs is told where some seeds have none.
    """
    values, others = paired(mine, base, read)
    if not len(values):
        return "-"
    if mine is base:
        return f"{values.mean():.3g}"
    pairs = "" if len(values) == min(len(mine), len(base)) else f", n={len(values)}"
    return f"{values.mean():.3g} {bracketed(values - others)}{pairs}"


def bracketed(differences: Array) -> str:
    """Interval of the mean difference, of two or fewer their span, in brackets."""
    low, high = interval(differences) if len(differences) > 2 else (differences.min(), differences.max())
    return f"({digits(low, '+')} .. {digits(high, '+')})"


def mean(name: str, scale: float = 1.0) -> Callable[[Sequence[Row]], str]:
    """Mean of a measure of rows."""
    return lambda rows: f"{scale * np.mean([row[name] for row in rows]):.1f}"


def total(name: str) -> Callable[[Sequence[Row]], str]:
    """Sum of a measure of rows."""
    return lambda rows: str(sum(row[name] for row in rows))


def counted(test: Callable[..., bool]) -> Callable[[Sequence[tuple[Any, ...]]], str]:
    """Number of pairs of which something holds."""
    return lambda pairs: str(sum(starmap(test, pairs)))


def metric(scale: float, *path: str) -> Read:
    """A measure among the metrics of a row, by its names from the outermost on."""

    def read(row: Row) -> float | None:
        value: Any = reduce(lambda found, name: (found or {}).get(name), path, row["metrics"])
        return None if value is None else scale * value

    return read


def middle(values: Sequence[float], places: int = 0) -> str:
    """Median with so many places; a dash where there is nothing."""
    return f"{np.median(values):.{places}f}" if values else "-"


def portion(some: int, of: int) -> str:
    """95 % interval of a share [%]."""
    low, high = share(some, of)
    return f"{100 * low:.0f} .. {100 * high:.0f} %"


def difference(values: Array, scale: float = 1.0) -> str:
    """Mean of paired differences and, in brackets, its interval; differences that are not finite are left out."""
    known = scale * np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return f"{digits(known.mean(), '+')} {bracketed(known)}" if len(known) else "-"


def comparison(measures: Mapping[str, Read], variants: Mapping[str, Sequence[Row]], base: str, head: str = "") -> str:
    """A table of measures by variants that have rows, each against the base."""
    flown = {name: rows for name, rows in variants.items() if rows}
    lines = [
        [measure, *(against(rows, flown[base], read) for rows in flown.values())] for measure, read in measures.items()
    ]
    return table([head, *flown], lines)
