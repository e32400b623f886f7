"""Robust losses: rho(s) of the squared whitened norm s = |r|^2 replaces s in the cost 1/2 s.

A loss enters Gauss-Newton through its weight rho'(s) (iteratively reweighted least squares); the gradient
rho'(s) J' r is the true one, so the KKT check judges the robust problem itself.

The formulas of the shipped losses stand in :func:`value_of`, :func:`weight_of` and :func:`bend_of`, for one number and
compiled; the classes apply them to arrays. They are compiled without liberties, so that NaN stays NaN and nothing is
reordered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import log1p, sqrt
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np

from unifg.codegen.jit import in_order
from unifg.errors import GraphError, require_positive
from unifg.typing import Array

QUADRATIC, HUBER, CAUCHY, TUKEY, SCALED, GEMAN_MCCLURE, TRUNCATED = range(7)
Form: TypeAlias = tuple[int, float, float]
"""A loss as compiled code knows it: which formula, and its two parameters (zero where it has fewer)."""
_SHARP = 1e4  # mu of a truncated loss whose weights go from one to zero within 0.01 % of the threshold


class Loss(Protocol):
    """A robust loss.

    Attributes:
        held: whether weights found at a linearisation are kept during its line search.
    """

    held: bool

    def value(self, squared: Array) -> Array:
        """rho(s) for (n,) squared norms."""

    def weight(self, squared: Array) -> Array:
        """rho'(s) for (n,) squared norms, non-negative."""


@runtime_checkable
class Graduated(Loss, Protocol):
    """A loss that comes with easier versions of itself, for graduated non-convexity."""

    def surrogates(self, largest: float, growth: float) -> Iterator[Loss]:
        """Losses from nearly convex at squared norms up to ``largest`` to this one, the last."""


class Formula:
    """A loss whose formulas stand in :func:`value_of` and :func:`weight_of`."""

    held = False

    def __post_init__(self) -> None:
        """Refuse parameters that are not positive and finite.

        Raises:
            GraphError: naming the loss.
        """
        require_positive(type(self).__name__, GraphError, **vars(self))

    @property
    def form(self) -> Form:
        """Form of the loss in compiled code."""
        raise NotImplementedError

    def value(self, squared: Array) -> Array:
        """rho(s) for an array of squared norms."""
        return self._each(squared, False)

    def weight(self, squared: Array) -> Array:
        """rho'(s) for an array of squared norms."""
        return self._each(squared, True)

    def _each(self, squared: Array, slopes: bool) -> Array:
        given = np.asarray(squared, dtype=np.float64)
        out = np.empty(given.shape)
        _fill(*self.form, slopes, np.ascontiguousarray(given).reshape(-1), out.reshape(-1))
        return out


@dataclass(frozen=True)
class Huber(Formula):
    """Quadratic up to ``threshold`` whitened units, linear beyond (Huber 1964): s inside, 2 k sqrt(s) - k^2 outside.

    Attributes:
        threshold: k, in units of the whitened residual's norm.
    """

    threshold: float = 1.345

    @property
    def form(self) -> Form:
        """Form with k."""
        return HUBER, self.threshold, 0.0


@dataclass(frozen=True)
class Cauchy(Formula):
    """rho(s) = k^2 log(1 + s / k^2): bounded influence, no convexity.

    Attributes:
        scale: k, in units of the whitened residual's norm.
    """

    scale: float = 2.385

    @property
    def form(self) -> Form:
        """Form with k^2."""
        return CAUCHY, self.scale**2, 0.0


@dataclass(frozen=True)
class Tukey(Formula):
    """Biweight: residuals beyond ``threshold`` have no influence at all.

    rho(s) = c^2/3 (1 - (1 - s/c^2)^3), constant beyond c^2.

    Attributes:
        threshold: c, in units of the whitened residual's norm.
    """

    threshold: float = 4.685

    @property
    def form(self) -> Form:
        """Form with c^2."""
        return TUKEY, self.threshold**2, 0.0


@dataclass(frozen=True)
class DCS(Formula):
    """Dynamic covariance scaling: switchable constraints with the switches eliminated (Agarwal et al. 2013).

    A residual with s = |W r|^2 is scaled by t = min(1, 2 Phi / (Phi + s)). The scaling is the minimiser
    of a cost of its own, so the loss has a closed form (MacTavish and Barfoot 2015): quadratic up to s = Phi, then
    4 Phi s / (Phi + s) - Phi, which flattens towards 3 Phi.

    Attributes:
        phi: Phi, in units of the *squared* norm of the whitened residual.
    """

    phi: float = 1.0

    def scaling(self, squared: Array) -> Array:
        """t(s), the factor on the residual: what a switch variable would have become."""
        return np.minimum(1.0, 2.0 * self.phi / (self.phi + squared))

    @property
    def form(self) -> Form:
        """Form with Phi."""
        return SCALED, self.phi, 0.0


@dataclass(frozen=True)
class GemanMcClure(Formula):
    """rho(s) = mu c^2 s / (mu c^2 + s), bounded by mu c^2 (Geman and McClure 1985; surrogate of Yang et al. 2020).

    Attributes:
        scale: c, in units of the whitened residual's norm.
        mu: 1 is the loss itself; larger values are its surrogates, convex over a wider range.
    """

    scale: float = 1.0
    mu: float = 1.0

    @property
    def form(self) -> Form:
        """Form with the bound mu c^2."""
        return GEMAN_MCCLURE, self.mu * self.scale**2, 0.0

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
class TruncatedLeastSquares(Formula):
    """rho(s) = min(s, c^2): a factor counts in full or not at all (surrogate of Yang et al. 2020).

    The surrogates are s, then 2 c sqrt(s mu (mu + 1)) - mu (c^2 + s), then c^2.

    Attributes:
        threshold: c, in units of the whitened residual's norm.
        mu: infinite for the loss itself; small values are its surrogates, convex over a wider range.
    """

    threshold: float = 3.0
    mu: float = np.inf

    def __post_init__(self) -> None:
        """Refuse parameters that are not positive."""
        require_positive(type(self).__name__, GraphError, threshold=self.threshold)
        require_positive(type(self).__name__, GraphError, finite=False, mu=self.mu)

    @property
    def form(self) -> Form:
        """Form with c and mu."""
        return TRUNCATED, self.threshold, self.mu

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


def form_of(loss: Loss | None) -> Form | None:
    """Form of a loss in compiled code; None where its formulas are Python, also in a subclass of a shipped one."""
    if loss is None:
        return QUADRATIC, 0.0, 0.0
    shipped = isinstance(loss, Formula) and (type(loss).value, type(loss).weight) == (Formula.value, Formula.weight)
    return loss.form if isinstance(loss, Formula) and shipped else None


@in_order
def value_of(kind: int, first: float, second: float, squared: float) -> float:
    """rho(s) of the shipped losses."""
    if kind == HUBER:
        return squared if squared <= first * first else 2.0 * first * sqrt(squared) - first * first
    if kind == CAUCHY:
        return first * log1p(squared / first)
    if kind == TUKEY:  # multiplied out, it does not cancel for small s
        share = squared / first
        share = 1.0 if share > 1.0 else share
        return first / 3.0 * share * (3.0 - 3.0 * share + share * share)
    if kind == SCALED:
        return squared if squared <= first else 4.0 * first * squared / (first + squared) - first
    if kind == GEMAN_MCCLURE:
        return first * squared / (first + squared)
    if kind == TRUNCATED:
        bound = first * first
        if second == np.inf:
            return bound if squared > bound else squared
        if squared <= bound * second / (second + 1.0):
            return squared
        # c^2 minus a square: the published form cancels for large mu.
        most = bound * (second + 1.0) / second
        gap = sqrt((second + 1.0) * bound) - sqrt(second * (most if squared > most else squared))
        return bound - gap * gap
    return squared


@in_order
def weight_of(kind: int, first: float, second: float, squared: float) -> float:
    """rho'(s) of the shipped losses."""
    if kind == HUBER:
        return first / sqrt(first * first if squared < first * first else squared)
    if kind == CAUCHY:
        return 1.0 / (1.0 + squared / first)
    if kind == TUKEY:
        share = squared / first
        share = 1.0 if share > 1.0 else share
        return (1.0 - share) * (1.0 - share)
    if kind == SCALED:
        scaling = 2.0 * first / (first + squared)
        return 1.0 if scaling > 1.0 else scaling * scaling
    if kind == GEMAN_MCCLURE:
        share = first / (first + squared)
        return share * share
    if kind == TRUNCATED:
        inside = first * first
        if second == np.inf:
            return 1.0 if squared <= inside else 0.0
        inside = inside * second / (second + 1.0)
        if squared <= inside:
            return 1.0
        between = first * sqrt(second * (second + 1.0) / squared) - second
        return 0.0 if between < 0.0 else 1.0 if between > 1.0 else between
    return 1.0


@in_order
def bend_of(kind: int, first: float, second: float, squared: float) -> float:
    """rho''(s) of the shipped losses, from inside at an edge."""
    if kind == HUBER:
        return 0.0 if squared <= first * first else -0.5 * first / (squared * sqrt(squared))
    if kind == CAUCHY:
        return -1.0 / (first * (1.0 + squared / first) * (1.0 + squared / first))
    if kind == TUKEY:
        return 0.0 if squared > first else -2.0 / first * (1.0 - squared / first)
    if kind == SCALED:
        whole = first + squared
        return 0.0 if squared <= first else -8.0 * (first / whole) * (first / whole) / whole
    if kind == GEMAN_MCCLURE:
        whole = first + squared
        return -2.0 * (first / whole) * (first / whole) / whole
    if kind == TRUNCATED and second != np.inf:
        slope = first * sqrt(second * (second + 1.0) / squared) if squared > 0.0 else np.inf
        return -0.5 * slope / squared if 0.0 < slope - second < 1.0 else 0.0
    return 0.0


@in_order
def _fill(kind: int, first: float, second: float, slopes: bool, squared: Array, out: Array) -> None:
    """``out`` = rho'(s) or rho(s) of all."""
    for i in range(len(squared)):
        if slopes:
            out[i] = weight_of(kind, first, second, squared[i])
        else:
            out[i] = value_of(kind, first, second, squared[i])
