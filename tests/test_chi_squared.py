"""Quantiles of chi-squared variables beside SciPy's."""

import pytest
from scipy.special import chdtri

from unifg.solution.chi_squared import upper_quantile


@pytest.mark.parametrize("freedom", [1, 2, 3, 6, 7, 30, 999.5, 1e6])
def test_a_quantile_is_scipys(freedom: float) -> None:
    for chance in (0.999, 0.99, 0.5, 0.01, 1e-3, 1e-6):
        assert upper_quantile(freedom, chance) == pytest.approx(chdtri(freedom, chance), rel=1e-6)
    assert upper_quantile(freedom, 1e-10) == pytest.approx(chdtri(freedom, 1e-10), rel=1e-3)
    assert upper_quantile(freedom, 1.0) < 1e-15 * freedom
