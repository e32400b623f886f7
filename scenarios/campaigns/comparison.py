"""What rows say: rates, means, and differences between variants that met the same seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy.stats import binomtest

from unifg.scenarios.campaigns.markdown import table
from unifg.typing import Array

__all__ = [
    "Key",
    "Read",
    "Row",
    "against",
    "by_chance",
    "comparison",
    "crossed",
    "digits",
    "interval",
    "paired",
    "share",
    "where",
]

Key: TypeAlias = tuple[Any, ...]
Row: TypeAlias = dict[str, Any]
Read: TypeAlias = Callable[[Row], float | None]
"""A measure of a row; None where it has none."""

RESAMPLES = 2000


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


def interval(differences: Array) -> tuple[float, float]:
    """95 % bootstrap interval of the mean."""
    rng = np.random.default_rng(0)
    means = rng.choice(differences, (RESAMPLES, len(differences))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def by_chance(differences: Array) -> float:
    """How likely a mean as far from zero is when signs are by chance: the sign-flip test of paired differences.

    Exact up to twelve differences, beyond by 4096 random flips (Phipson & Smyth 2010: never zero).

    Args:
        differences: (n,) of pairs.
    """
    n, flips = len(differences), 4096
    if n <= 12:
        signs = 1.0 - 2.0 * ((np.arange(1 << n)[:, None] >> np.arange(n)) & 1)
        extra = 0
    else:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (flips, n))
        extra = 1
    found = abs(float(differences.sum())) * (1.0 - 1e-12)
    hits = int(np.count_nonzero(np.abs(signs @ differences) >= found))
    return (hits + extra) / (len(signs) + extra)


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


def share(hits: int, of: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson 1927)."""
    if not of:
        return 0.0, 1.0
    found = binomtest(hits, of).proportion_ci(0.95, "wilson")
    return float(found.low), float(found.high)


def digits(value: float, sign: str = "") -> str:
    """Two significant digits, all of those before the point."""
    return f"{value:{sign}.0f}" if abs(value) >= 10.0 else f"{value:{sign}.2g}"
