"""Robust losses: rho(s) of the squared whitened norm s = |r|^2 replaces s in the cost 1/2 s.

A loss enters Gauss-Newton through its weight rho'(s) (iteratively reweighted least squares); the gradient
rho'(s) J' r is the true one, so the KKT check judges the robust problem itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from unifg.errors import GraphError
from unifg.typing import Array


class Loss(Protocol):
    """A robust loss.

    Attributes:
        held: whether weights found at a linearisation are kept during its line search.
    """

    held: bool

    def value(self, squared: Array) -> Array:
        """rho(s) for (n,) squared norms."""
        ...

    def weight(self, squared: Array) -> Array:
        """rho'(s) for (n,) squared norms, non-negative."""
        ...


@dataclass(frozen=True)
class Huber:
    """Quadratic up to ``threshold`` whitened units, linear beyond (Huber 1964).

    Attributes:
        threshold: in units of the whitened residual's norm.
    """

    threshold: float = 1.345
    held = False

    def __post_init__(self) -> None:
        """Refuse a threshold that is not positive."""
        positive(self.threshold, "Huber")

    def value(self, squared: Array) -> Array:
        """rho(s) = s inside, 2 k sqrt(s) - k^2 outside."""
        k = self.threshold
        return np.where(squared <= k * k, squared, 2.0 * k * np.sqrt(squared) - k * k)

    def weight(self, squared: Array) -> Array:
        """rho'(s) = 1 inside, k / sqrt(s) outside."""
        k = self.threshold
        return k / np.sqrt(np.maximum(squared, k * k))


@dataclass(frozen=True)
class Cauchy:
    """rho(s) = k^2 log(1 + s / k^2): bounded influence, no convexity.

    Attributes:
        scale: k, in units of the whitened residual's norm.
    """

    scale: float = 2.385
    held = False

    def __post_init__(self) -> None:
        """Refuse a scale that is not positive."""
        positive(self.scale, "Cauchy")

    def value(self, squared: Array) -> Array:
        """Value of the loss."""
        return self.scale**2 * np.log1p(squared / self.scale**2)

    def weight(self, squared: Array) -> Array:
        """rho'(s) = 1 / (1 + s / k^2)."""
        return 1.0 / (1.0 + squared / self.scale**2)


@dataclass(frozen=True)
class Tukey:
    """Biweight: residuals beyond ``threshold`` have no influence at all.

    Attributes:
        threshold: c, in units of the whitened residual's norm.
    """

    threshold: float = 4.685
    held = False

    def __post_init__(self) -> None:
        """Refuse a threshold that is not positive."""
        positive(self.threshold, "Tukey")

    def value(self, squared: Array) -> Array:
        """rho(s) = c^2/3 (1 - (1 - s/c^2)^3), constant beyond c."""
        c2 = self.threshold**2
        return c2 / 3.0 * (1.0 - (1.0 - np.minimum(squared / c2, 1.0)) ** 3)

    def weight(self, squared: Array) -> Array:
        """rho'(s) = (1 - s/c^2)^2 inside, 0 outside."""
        return (1.0 - np.minimum(squared / self.threshold**2, 1.0)) ** 2


@dataclass(frozen=True)
class Reweighted:
    """Piecewise rules such as "a quarter below one cell, nothing beyond 0.3 m" (Bazzana VII-A).

    The weight is found at each linearisation and held during its line search; the cost of a factor is
    w(s) s with that weight, so accepting a step never depends on a factor crossing a threshold.

    Attributes:
        rule: maps (n,) squared whitened norms to (n,) weights.
    """

    rule: Callable[[Array], Array]
    held = True

    def value(self, squared: Array) -> Array:
        """w(s) s."""
        return self.rule(squared) * squared

    def weight(self, squared: Array) -> Array:
        """w(s), the derivative of w(s) s wherever the weight is locally constant."""
        return self.rule(squared)


def positive(value: float, name: str) -> None:
    """Raise unless a loss parameter is positive and finite."""
    if not (np.isfinite(value) and value > 0.0):
        raise GraphError(f"{name}: its parameter must be positive and finite, found {value}")
