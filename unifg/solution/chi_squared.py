"""Quantiles of chi-squared variables, without SciPy: it takes longer to load than a map of 1000 poses to solve."""

from __future__ import annotations

import math


def upper_quantile(freedom: float, chance: float) -> float:
    """Value that a chi-squared variable exceeds with a probability.

    The series of the incomplete gamma function (Abramowitz and Stegun 6.5.29) is bisected below a bound of Laurent and
    Massart (2000, lemma 1). Right to six digits for chances above 1e-6, to three above 1e-10.

    Args:
        freedom: degrees of freedom, above zero and finite.
        chance: the probability, above zero and at most one.
    """
    spread = -math.log(chance)
    low, high = 0.0, freedom + 2.0 * math.sqrt(freedom * spread) + 2.0 * spread
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _share_below(0.5 * freedom, 0.5 * middle) < 1.0 - chance else (low, middle)
    return high


def _share_below(shape: float, value: float) -> float:
    """Regularised lower incomplete gamma function."""
    if value <= 0.0:
        return 0.0
    addend = total = math.exp(shape * math.log(value) - value - math.lgamma(shape + 1.0))
    while addend > 1e-17 * total:
        shape += 1.0
        addend *= value / shape
        total += addend
    return total
