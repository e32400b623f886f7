"""Control barrier functions of any clearance (Yang et al. 2025, *FactorMPC*, section III-C.4 and 5).

A barrier function h(x, t, ...) is at least zero where all is well. It is made of a clearance: any residual that says
how far something is, in metres, one column per obstacle, as those of :mod:`unifg.models.avoidance`, of
:mod:`unifg.models.obstacles` and of :mod:`unifg.models.clearances`, or a function of one's own. t is the time from now;
who moves with it is said by :func:`still`, :func:`moving`, :func:`accelerated` or :func:`thrown`. Then h' >= -alpha h
is asked for (eq. 6), in one of two ways:

- :func:`decay`, between two nodes: h(x_next, t + dt) >= exp(-alpha dt) h(x, t), whatever dt. It is what h' >= -alpha h
  comes to after dt seconds, and keeps the sign of h for any alpha; with 1 - alpha dt in the place of the exponential a
  plan could be asked to change sides.
- :func:`condition`, at one node, as the paper has it (eq. 18, 22): h'(x, u, t) + alpha h(x, t) >= 0.

Both are residuals to be held at ``lower=0``. Three ways to hold them are in :mod:`unifg.models.keeping`.

Where the paper and this module differ: here h' counts the motion of the obstacle as well, and the velocity-extended
barrier loses alpha h of itself and not of the distance alone. What is printed is to be had with ``as_published=True``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from unifg.errors import ModelError, require_kinds, require_positive
from unifg.factors.autodiff.rates import rate
from unifg.factors.residuals import Residual
from unifg.lie import Manifold
from unifg.models import quadrotor
from unifg.models.quadrotor import P, V
from unifg.typing import Array

__all__ = [
    "accelerated",
    "condition",
    "decay",
    "inverse",
    "moving",
    "share",
    "still",
    "thrown",
    "uncertain",
    "velocity_extended",
]

Clearance: TypeAlias = Callable[..., Array] | Residual
"""``clearance(x, ...)``: (n, M) [m], x (n, storage) positions, poses or states."""

Barrier: TypeAlias = Callable[..., Array]
"""``h(x, t, ...)``: (n, M), t [s] a number or (n,)."""

Flow: TypeAlias = Callable[[Array, Array], Array]
"""``f(x, u)``: x' in the tangent space, (n, dim)."""

AMBIGUOUS = "say many=True for a function of a set of obstacles, many=False for one of a single one"

DOWN = np.array([0.0, 0.0, -quadrotor.GRAVITY])  # [m/s^2]


# ---------------------------------------------------------------- what time does to a clearance


def still(clearance: Clearance) -> Barrier:
    """``h(x, t, *obstacle)``: the clearance, at any time."""

    def of_resting(x: Array, t: Any, *obstacle: Any) -> Array:
        return clearance(x, *obstacle)

    return of_resting


def moving(clearance: Clearance, many: bool | None = None) -> Barrier:
    """``h(x, t, centre, velocity, *rest)``: of what goes straight on, ``clearance(x, centre + t velocity, *rest)``.

    Any other motion is a function ``h(x, t, ...)`` of one's own that calls the clearance.

    Args:
        clearance: of one obstacle, or of a set of them.
        many: whether it takes a set, centres (M, d) or (n, M, d), or one, (d,) or (n, d). None asks a clearance that
            ships; a plain function then takes one.

    Returns:
        A barrier: centre [m] as the clearance takes it, velocity [m/s] of the same shape; variables, data, constants.

    Raises:
        ModelError: from the barrier, where centres may be those of a set that nobody has spoken of: (M, d) for a
            function of one obstacle, of which n is no other number or M rows come back.
    """
    falling = accelerated(clearance, many)

    def of_moving(x: Array, t: Any, centre: Array, velocity: Array, *rest: Any) -> Array:
        return falling(x, t, centre, velocity, None, *rest)

    return of_moving


def accelerated(clearance: Clearance, many: bool | None = None) -> Barrier:
    """``h(x, t, centre, velocity, acceleration, *rest)``: of what accelerates, as by falling [m/s^2].

    Arguments as those of :func:`moving`.
    """
    axes = _axes(clearance) if many is None else 1 + many

    def of_accelerated(x: Array, t: Any, centre: Array, velocity: Array, acceleration: Any, *rest: Any) -> Array:
        if axes is None:
            _refuse_sets(centre, t)
        each = (-1,) + (1,) * (axes or 1)
        s = np.reshape(t, each if np.size(t) > 1 else ())  # one time for all factors stays a number
        there = centre + s * velocity
        if acceleration is not None:
            there = there + 0.5 * s * s * acceleration
        found = clearance(x, there, *rest)
        if axes is None and np.size(t) > 1 and np.ndim(centre) == 2 and len(centre) == found.shape[1] > 1:
            raise ModelError(f"{found.shape[1]} centres, as many rows and as many times: {AMBIGUOUS}")
        return found

    return of_accelerated


def thrown(clearance: Clearance, many: bool | None = None) -> Barrier:
    """``h(x, t, centre, velocity, *rest)``: of what falls freely in space, without drag.

    Arguments as those of :func:`moving`.
    """
    falling = accelerated(clearance, many)

    def of_thrown(x: Array, t: Any, centre: Array, velocity: Array, *rest: Any) -> Array:
        return falling(x, t, centre, velocity, DOWN, *rest)

    return of_thrown


def _axes(clearance: Clearance) -> int | None:
    """Axes of an obstacle's centre for one factor: two of a set, one of a single one; None where nobody says."""
    kernel = clearance.kernel if isinstance(clearance, Residual) else None
    if kernel is None:
        return None
    expected = kernel.arguments[1]
    return expected if isinstance(expected, int) else len(expected) if isinstance(expected, tuple) else 1


def _refuse_sets(centre: Array, t: Any) -> None:
    """Refuse what cannot be one centre for each time."""
    times, axes = np.size(t), np.ndim(centre)
    if times > 1 and (axes > 2 or (axes == 2 and len(centre) not in (1, times))):
        raise ModelError(f"centres of shape {np.shape(centre)} for {times} times: {AMBIGUOUS}")


# ---------------------------------------------------------------- barriers made of others


def inverse(h: Barrier, safe: float) -> Barrier:
    """``1 / safe - 1 / (safe + h)`` [1/m] (eq. 15), with h = d - safe: zero where h is, with a pole where d is zero.

    Args:
        h: in metres, of obstacles that are kept at a distance ``safe`` from their centres.
        safe: d_safe, radius and margin [m].

    Raises:
        ModelError: when it is not positive: a point is at distance zero from itself, and 1/0 no number.
    """
    require_positive("1/d_safe - 1/d (for points use the distance itself)", ModelError, safe=safe)

    def of_inverse(x: Array, t: Any, *obstacle: Any) -> Array:
        return 1.0 / safe - 1.0 / (safe + h(x, t, *obstacle))

    return of_inverse


def velocity_extended(h: Barrier, distance: Barrier, gamma: float, *, p: slice = P, v: slice = V) -> Barrier:
    """``h + gamma d'`` (eq. 20): with d a distance, n (v - v_o) is how fast it grows.

    Its set {h_v >= 0} is no subset of {h >= 0}: what recedes may be inside. Hold the distance barrier as well.

    Args:
        h: barrier on positions.
        distance: that grows or shrinks, on positions; h itself where h is in metres and certain. A standard deviation
            is a root, without a slope where it is zero.
        gamma: of the velocity, not negative: [s] with h in metres, [s/m^2] with :func:`inverse`.
        p: where positions stand in a state; those of a quadrotor.
        v: where velocities in the world's axes do.

    Returns:
        ``h_v(x, t, *obstacle)`` on states (n, storage).

    Raises:
        ModelError: on a gamma that is negative or not finite.
    """
    _not_negative("gamma", gamma)

    def of_velocity(x: Array, t: Any, *obstacle: Any) -> Array:
        def ahead(s: Any, x: Array, t: Any, *obstacle: Any) -> Array:
            return distance(x[:, p] + s * x[:, v], t + s, *obstacle)

        extended: Array = h(x[:, p], t, *obstacle) + gamma * rate(ahead, x, t, *obstacle)
        return extended

    return of_velocity


def uncertain(h: Barrier, k: float, manifold: Manifold | None = None) -> Barrier:
    """``h(x, t, *obstacle) - k sigma_h``, with sigma_h from a square root of a covariance: ``(x, t, root, *obstacle)``.

    sigma_h^2 = sum over the columns of the root of the squared change of h along them, so a long axis of an ellipse
    that lies along the obstacle costs nothing. For a position estimated together with that of an obstacle, root root'
    is the covariance of their difference.

    Args:
        h: on x.
        k: of standard deviations, not negative.
        manifold: of x, in whose tangent space the root is given, as ``solution.covariance`` has it; None for Rn.

    Returns:
        A barrier whose third argument is the root, (n, d, c) or (d, c), [m].

    Raises:
        ModelError: on a k that is negative or not finite.
    """
    _not_negative("k", k)

    def of_uncertain(x: Array, t: Any, root: Array, *obstacle: Any) -> Array:
        def along(s: Any, x: Array, column: Array) -> Array:
            moved = x + s * column if manifold is None else manifold.retract(x, s * column)
            return h(moved, t, *obstacle)

        square: Any = 0.0
        for c in range(root.shape[-1]):
            change = rate(along, x, root[..., c])
            square = square + change * change
        left: Array = h(x, t, *obstacle) - k * np.sqrt(square)
        return left

    return of_uncertain


# ---------------------------------------------------------------- h' >= -alpha h


def share(alpha: float, t: Any) -> Any:
    """``exp(-alpha t)``: how much of a barrier must be left after t seconds, same shape as t [s]."""
    return np.exp(-alpha * t)


def decay(h: Barrier, alpha: float) -> Callable[..., Array]:
    """``h(x_next, t + dt) - exp(-alpha dt) h(x, t)``, as ``(x, x_next, t, dt, *obstacle)``, (n, M).

    At each solve all of an interval's share could be spent in the first tick, and the next solve would hand out the
    next: make the first interval as long as a tick is, see :func:`unifg.models.keeping.grid`.

    Args:
        h: barrier.
        alpha: share that may be lost [1/s]; zero: none, so that h may not shrink; large: h_next >= 0.

    Returns:
        A residual for ``lower=0``. t, dt: numbers or (n,) [s].

    Raises:
        ModelError: on an alpha that is negative or not finite.
    """
    _not_negative("alpha", alpha)

    def barrier(x: Array, x_next: Array, t: Any, dt: Any, *obstacle: Any) -> Array:
        kept = np.reshape(share(alpha, dt), (-1, 1))
        return h(x_next, t + dt, *obstacle) - kept * h(x, t, *obstacle)

    return barrier


def condition(
    h: Barrier,
    alpha: float,
    manifold: Manifold,
    flow: Flow,
    *,
    as_published: bool = False,
    lost: Barrier | None = None,
) -> Callable[..., Array]:
    """``h'(x, u, t) + alpha h(x, t)``, as ``(x, u, t, *obstacle)``, (n, M) (eq. 6, 18, 22).

    Args:
        h: barrier on x.
        alpha: [1/s].
        manifold: of x.
        flow: ``f(x, u)``, x' in the tangent space: ``lambda p, v: v`` for positions, the field of a vehicle for states.
        as_published: whether obstacles rest in h', as in eq. 18 and 21; their velocity in h itself stays.
        lost: barrier in the place of h in alpha h: eq. 22 prints that of the distance in the velocity-extended one.

    Returns:
        A residual for ``lower=0``.

    Raises:
        ModelError: on an alpha that is negative or not finite.
    """
    _not_negative("alpha", alpha)
    spent, passing = h if lost is None else lost, 0.0 if as_published else 1.0

    def barrier(x: Array, u: Array, t: Any, *obstacle: Any) -> Array:
        def ahead(s: Any, x: Array, u: Array, t: Any, *obstacle: Any) -> Array:
            return h(manifold.retract(x, s * flow(x, u)), t + s * passing, *obstacle)

        left: Array = rate(ahead, x, u, t, *obstacle) + alpha * spent(x, t, *obstacle)
        return left

    return barrier


def _not_negative(name: str, value: float) -> None:
    require_kinds("a barrier", ModelError, {name: "float"}, {name: value})
    if not (value >= 0.0 and math.isfinite(value)):
        raise ModelError(f"{name} of a barrier must be a finite number, zero or more, found {value!r}")
