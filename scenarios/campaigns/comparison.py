"""Intervals and tests: rates, means, and paired differences."""

from __future__ import annotations

import numpy as np
from scipy.stats import binomtest, bootstrap, permutation_test

from unifg.typing import Array

__all__ = ["by_chance", "digits", "interval", "share"]

RESAMPLES = 2000
FLIPS = 4096


def interval(differences: Array) -> tuple[float, float]:
    """95 % bootstrap interval of the mean; of one value the value itself."""
    if len(differences) < 2:
        return float(differences[0]), float(differences[0])
    found = bootstrap((differences,), np.mean, n_resamples=RESAMPLES, method="percentile", rng=0).confidence_interval
    return float(found.low), float(found.high)


def by_chance(differences: Array) -> float:
    """Chance of a mean as far from zero when signs are by chance: the sign-flip test of paired differences.

    Exact up to twelve differences, beyond by 4096 random flips (Phipson & Smyth 2010: never zero).

    Args:
        differences: (n,) of pairs.
    """
    if len(differences) < 2:  # either sign of a single one is as far from zero
        return 1.0
    found = permutation_test(
        (differences,), _size, permutation_type="samples", alternative="greater", n_resamples=FLIPS, rng=0
    )
    return float(found.pvalue)


def _size(differences: Array, axis: int) -> Array:
    size: Array = np.abs(differences.mean(axis=axis))
    return size


def share(hits: int, of: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson 1927)."""
    if not of:
        return 0.0, 1.0
    found = binomtest(hits, of).proportion_ci(0.95, "wilson")
    return float(found.low), float(found.high)


def digits(value: float, sign: str = "") -> str:
    """Two significant digits, all of those before the point."""
    return f"{value:{sign}.0f}" if abs(value) >= 10.0 else f"{value:{sign}.2g}"
