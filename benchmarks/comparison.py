"""Rows of a measurement by variant: which of them met the same seeds, and how far these differ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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
    return [row for row in rows if "error" not in row and all(row[name] == value for name, value in wanted.items())]


def crossed(rows: Iterable[Row], *names: str) -> dict[Key, list[Row]]:
    """Rows by their values of some fields, in the order of seeds; a seed counts when all groups have it."""
    groups: dict[Key, dict[int, Row]] = {}
    for row in where(rows):
        groups.setdefault(tuple(row[name] for name in names), {})[row["seed"]] = row
    common = sorted(set[int].intersection(*map(set, groups.values()))) if groups else []
    return {key: [found[seed] for seed in common] for key, found in groups.items()}


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
    low, high = interval(values - others)
    pairs = "" if len(values) == min(len(mine), len(base)) else f", n={len(values)}"
    return f"{values.mean():.3g} ({digits(low, '+')} .. {digits(high, '+')}){pairs}"


def comparison(measures: Mapping[str, Read], variants: Mapping[str, Sequence[Row]], base: str, head: str = "") -> str:
    """A table of measures by variants that have rows, each against the base."""
    flown = {name: rows for name, rows in variants.items() if rows}
    lines = [
        [measure, *(against(rows, flown[base], read) for rows in flown.values())] for measure, read in measures.items()
    ]
    return table([head, *flown], lines)
