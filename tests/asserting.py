"""Functions that assert something about their arguments; pytest rewrites assertions of test modules."""

from typing import Any

import numpy as np

from unifg.typing import Array


def below(x: Array) -> Array:
    assert np.all(x < 1.0), "too far"
    if np.any(x < -5.0) or np.isnan(x).any():
        raise ValueError(f"far below: {float(x.min()):.2f}")
    return x


def edge(x: Array) -> Array:
    assert np.all(x <= 1.000001)
    return x


def helper(ok: Any) -> None:
    if not ok:
        raise ValueError("not so")


def nested(x: Array) -> Array:
    helper(np.all(x < 3.0) and (x > -3.0).all())
    for k in range(x.shape[1]):
        assert not np.any(x[:, k] ** 2 > 5.0 + k)
    if np.any(x[:, 0] > x[:, 1] + 2.0):
        if np.any(x[:, 1] > 0.0):
            raise ValueError("one")
        raise ValueError("other")
    return x


def decides(x: Array) -> Any:
    assert np.all(x < 3.0)
    if np.any(x > 0.0):
        return x
    return 2.0 * x


def newton(x: Array) -> Any:
    y = x
    while np.any(np.abs(y * y - 2.0) > 1e-9):
        y = 0.5 * (y + 2.0 / y)
    return y


def perhaps(x: Array) -> Any:
    if np.any(x > 0.0):
        if np.any(x > 1.0):
            raise ValueError("large")
        return x
    return 2.0 * x


def spread(x: Array) -> Array:
    assert x.mean() < 5.0
    return x
