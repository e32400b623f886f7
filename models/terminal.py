"""Terminal sets: states a vehicle can stay in, so that the next plan exists (the X_f of eq. 4).

A plan that satisfies hard barriers and ends in such a set can be continued by a step inside it; moved by one interval
it is a plan of the next solve. So the hard form is never infeasible on the nominal vehicle, if it was not at first.
This is so where a plan moves on by whole intervals. Where solves are more frequent than nodes, it is so with nodes that
stay where they are (:func:`unifg.models.keeping.aligned`), and not with nodes that move on by a tick: controls that are
held over the new intervals cannot repeat the old plan, and its nodes kept the barrier elsewhere. Then a plan may be
missing by millimetres, and what can be flown is the last one.

:data:`resting` asks the vehicle to hover at the end. :func:`brakeable` asks
that it could come to rest: with h in metres, v <= alpha h and v <= a / alpha, braking by a keeps both, since

    (alpha h - v)' >= -alpha v + a >= 0,   and so   h' >= -v >= -alpha h.

It is larger than the first. Both are for obstacles that rest: from one that comes nearer no resting vehicle is safe.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from unifg.errors import ModelError, require_positive
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import residual
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.models.barriers import Barrier
from unifg.models.quadrotor import P, R, V
from unifg.typing import Array

__all__ = ["brakeable", "resting"]


def _resting(x: Array) -> Array:
    up = SO3.act(x[:, R], np.array([[0.0, 0.0, 1.0]]))
    return np.concatenate([x[:, V], up[:, :2]], axis=1)


resting = residual(
    StatedKernel(_resting, (quadrotor.STATE,), 5, name="resting"),
    about="""``resting(x)``: velocity [m/s] and sine of the tilt about two axes, (n, 5): zero at hover without wind.""",
)


def brakeable(h: Barrier, alpha: float, deceleration: float, *, p: slice = P, v: slice = V) -> Callable[..., Array]:
    """``alpha h - v`` for each obstacle, and ``a / alpha - v``: ``(x, t, *obstacle)``, (n, M + 1) [m/s].

    Args:
        h: barrier on positions, in metres, of obstacles that rest: it loses no more than the vehicle travels.
        alpha: of its decay, positive [1/s].
        deceleration: a, that the vehicle has in any direction [m/s^2].
        p: where positions stand in a state; those of a quadrotor.
        v: where velocities do.

    Raises:
        ModelError: on an alpha or a deceleration that is not positive.
    """
    require_positive("brakeable", ModelError, alpha=alpha, deceleration=deceleration)

    def left(x: Array, t: Any, *obstacle: Any) -> Array:
        fast = np.linalg.norm(x[:, v], axis=1, keepdims=True)
        return np.concatenate([alpha * h(x[:, p], t, *obstacle) - fast, deceleration / alpha - fast], axis=1)

    return left
