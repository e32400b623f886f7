"""Robust losses: rho(s) of the squared whitened norm s = |r|^2 replaces s in the cost 1/2 s.

A loss enters Gauss-Newton through its weight rho'(s) (iteratively reweighted least squares); the gradient
rho'(s) J' r is the true one, so the KKT check judges the robust problem itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from unifg.errors import GraphError
from unifg.typing import Array

_SHARP = 1e4  # mu of a truncated loss whose weights go from one to zero within 0.01 % of the threshold


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


@runtime_checkable
class Graduated(Loss, Protocol):
    """A loss that comes with easier versions of itself, for graduated non-convexity."""

    def surrogates(self, largest: float, growth: float) -> Iterator[Loss]:
        """Losses from nearly convex at squared norms up to ``largest`` to this one, the last."""
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
        """rho(s) = c^2/3 (1 - (1 - s/c^2)^3), constant beyond c; multiplied out, it does not cancel for small s."""
        c2 = self.threshold**2
        share = np.minimum(squared / c2, 1.0)
        value: Array = c2 / 3.0 * share * (3.0 - 3.0 * share + share * share)
        return value

    def weight(self, squared: Array) -> Array:
        """rho'(s) = (1 - s/c^2)^2 inside, 0 outside."""
        return (1.0 - np.minimum(squared / self.threshold**2, 1.0)) ** 2


@dataclass(frozen=True)
class DCS:
    """Dynamic covariance scaling: switchable constraints with the switches eliminated (Agarwal et al. 2013).

    A residual with s = |W r|^2 is scaled by t = min(1, 2 Phi / (Phi + s)). The scaling is the minimiser
    of a cost of its own, so the loss has a closed form (MacTavish and Barfoot 2015): quadratic up to s = Phi, then
    flattening towards 3 Phi.

    Attributes:
        phi: Phi, in units of the *squared* norm of the whitened residual.
    """

    phi: float = 1.0
    held = False

    def __post_init__(self) -> None:
        """Refuse a parameter that is not positive."""
        positive(self.phi, "DCS")

    def scaling(self, squared: Array) -> Array:
        """t(s), the factor on the residual: what a switch variable would have become."""
        return np.minimum(1.0, 2.0 * self.phi / (self.phi + squared))

    def value(self, squared: Array) -> Array:
        """rho(s) = s up to Phi, 4 Phi s / (Phi + s) - Phi beyond."""
        phi = self.phi
        return np.where(squared <= phi, squared, 4.0 * phi * squared / (phi + squared) - phi)

    def weight(self, squared: Array) -> Array:
        """rho'(s) = t(s)^2."""
        return self.scaling(squared) ** 2


@dataclass(frozen=True)
class GemanMcClure:
    """rho(s) = mu c^2 s / (mu c^2 + s), bounded by mu c^2 (Geman and McClure 1985; surrogate of Yang et al. 2020).

    Attributes:
        scale: c, in units of the whitened residual's norm.
        mu: 1 is the loss itself; larger values are its surrogates, convex over a wider range.
    """

    scale: float = 1.0
    mu: float = 1.0
    held = False

    def __post_init__(self) -> None:
        """Refuse parameters that are not positive."""
        positive(self.scale, "GemanMcClure")
        positive(self.mu, "GemanMcClure")

    def value(self, squared: Array) -> Array:
        """Value of the loss."""
        bound = self.mu * self.scale**2
        return bound * squared / (bound + squared)

    def weight(self, squared: Array) -> Array:
        """rho'(s) = (mu c^2 / (mu c^2 + s))^2."""
        bound = self.mu * self.scale**2
        return (bound / (bound + squared)) ** 2

    def surrogates(self, largest: float, growth: float) -> Iterator[Loss]:
        """Losses from nearly convex to this one: mu from 2 max(s) / c^2 down to 1 (Yang et al. 2020).

        Args:
            largest: the largest squared norm at the start.
            growth: factor between neighbours, above 1.
        """
        mu = 2.0 * largest / self.scale**2
        while mu > self.mu:
            yield GemanMcClure(self.scale, mu)
            mu /= growth
        yield self


@dataclass(frozen=True)
class TruncatedLeastSquares:
    """rho(s) = min(s, c^2): a factor counts in full or not at all (surrogate of Yang et al. 2020).

    Attributes:
        threshold: c, in units of the whitened residual's norm.
        mu: infinite for the loss itself; small values are its surrogates, convex over a wider range.
    """

    threshold: float = 3.0
    mu: float = np.inf
    held = False

    def __post_init__(self) -> None:
        """Refuse parameters that are not positive."""
        positive(self.threshold, "TruncatedLeastSquares")
        if self.mu != np.inf:
            positive(self.mu, "TruncatedLeastSquares")

    def value(self, squared: Array) -> Array:
        """rho(s): s, then 2 c sqrt(s mu (mu + 1)) - mu (c^2 + s), then c^2 (Yang et al. 2020)."""
        mu, c2 = self.mu, self.threshold**2
        if mu == np.inf:
            return np.minimum(squared, c2)
        # c^2 minus a square: the published form cancels for large mu.
        gap = np.sqrt((mu + 1.0) * c2) - np.sqrt(mu * np.minimum(squared, c2 * (mu + 1.0) / mu))
        return np.where(squared <= c2 * mu / (mu + 1.0), squared, c2 - gap**2)

    def weight(self, squared: Array) -> Array:
        """rho'(s): 1, then c sqrt(mu (mu + 1) / s) - mu, then 0 (Yang et al. 2020)."""
        mu, c2 = self.mu, self.threshold**2
        if mu == np.inf:
            return np.where(squared <= c2, 1.0, 0.0)
        inside = c2 * mu / (mu + 1.0)
        between = self.threshold * np.sqrt(mu * (mu + 1.0) / np.maximum(squared, inside)) - mu
        return np.where(squared <= inside, 1.0, np.clip(between, 0.0, 1.0))

    def surrogates(self, largest: float, growth: float) -> Iterator[Loss]:
        """Losses from nearly convex to this one: mu from c^2 / (2 max(s) - c^2) up (Yang et al. 2020).

        Args:
            largest: the largest squared norm at the start.
            growth: factor between neighbours, above 1.
        """
        c2 = self.threshold**2
        mu = c2 / (2.0 * largest - c2) if 2.0 * largest > c2 else np.inf
        while mu < min(self.mu, _SHARP):
            yield TruncatedLeastSquares(self.threshold, mu)
            mu *= growth
        yield self


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
