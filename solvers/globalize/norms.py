"""Sizes of vectors."""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.typing import Array


@compiled
def norm(step: Array) -> float:
    """Euclidean norm, without waking the threads of a BLAS, and of steps whose squares overflow too."""
    squares = _squares(step)
    if 1e-200 < squares < 1e200:
        return math.sqrt(squares)
    size = _largest(step)
    return size if not 0.0 < size < np.inf else size * math.sqrt(_squares(step / size))


def largest(vector: Array) -> float:
    """Infinity norm."""
    return float(_largest(vector))


def geometric_mean(numbers: Array) -> float:
    """Geometric mean of those that are positive and finite; one where there are none."""
    known = numbers[(numbers > 0.0) & np.isfinite(numbers)]
    return float(np.exp2(np.log2(known).mean())) if len(known) else 1.0


@compiled
def total(vector: Array) -> float:
    """Sum of the absolute numbers."""
    result = 0.0
    for number in vector:
        result += abs(number)
    return result


@compiled
def _squares(vector: Array) -> float:
    total = 0.0
    for number in vector:
        total += number * number
    return total


@compiled
def _largest(vector: Array) -> float:
    result = 0.0
    for number in vector:
        if number != number:
            return np.nan
        result = max(result, abs(number))
    return result
