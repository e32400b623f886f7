"""Distances outside limits: compiled, and the same as NumPy's to the last bit, whatever the numbers."""

from __future__ import annotations

import numpy as np

from unifg.problem.limits import outside


def test_distances_outside_limits_are_those_of_numpy() -> None:
    numbers = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e-300, 5.0])
    g, lower, upper = (part.ravel() for part in np.meshgrid(numbers, numbers, numbers))
    found = np.empty(len(g))
    outside(g, lower, upper, found)
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(found, np.maximum(g - upper, 0.0) - np.maximum(lower - g, 0.0))
