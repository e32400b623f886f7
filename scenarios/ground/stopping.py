"""Coming to rest, or out of the way, without a solver and within the accelerations of a base.

Velocities change steadily over a tick, by ``most`` = acceleration times duration at the most. A plan that ends at rest
and keeps to that can be left at any time for :func:`stopped`, which comes to rest sooner along the same path.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.models import unicycle
from unifg.typing import Array

EVADING = 1.0  # [s] for which the robot evades before it brakes
TURNS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # turning rates tried, in shares of the greatest


def stopped(last: Array, plan: Array, most: Array, count: int) -> Array:
    """Velocities (count, 2) that bring a base to rest along the path of a plan, as soon as its accelerations allow.

    The plan is driven more and more slowly, both velocities by the same factor, so that the path keeps its shape. The
    factor that was good for one step is good for the next, because the plan itself keeps the accelerations; the least
    that they allow is taken. Where the plan does not go on from the velocities now, both fade by themselves.

    Args:
        last: (2,) velocities now [m/s, rad/s].
        plan: (k, 2) those that would come next.
        most: (2,) greatest changes in a step.
        count: of steps.
    """
    controls = np.zeros((count, 2))
    (v, omega), (dv, domega) = last.tolist(), most.tolist()
    ahead = [[v, omega], *plan.tolist(), [0.0, 0.0]]
    factor, progress = 1.0, 0.0
    for k in range(count):
        if abs(v) <= dv and abs(omega) <= domega:
            break
        progress = min(progress + factor, len(ahead) - 1.0)
        at = min(int(progress), len(ahead) - 2)
        share = progress - at
        wanted = [(1.0 - share) * a + share * b for a, b in zip(ahead[at], ahead[at + 1], strict=True)]
        low, high = _factors(v, wanted[0], dv)
        other_low, other_high = _factors(omega, wanted[1], domega)
        low, high = max(low, other_low, 0.0), min(high, other_high, factor)
        if low <= high:
            factor = low
            v, omega = factor * wanted[0], factor * wanted[1]
        else:
            v, omega = v - min(max(v, -dv), dv), omega - min(max(omega, -domega), domega)
        controls[k] = v, omega
    return controls


def _factors(now: float, wanted: float, most: float) -> tuple[float, float]:
    """Between which factors on a velocity that is wanted it differs by at most so much from that of now."""
    if wanted == 0.0:
        return (0.0, math.inf) if abs(now) <= most else (math.inf, -math.inf)
    ends = (now - most) / wanted, (now + most) / wanted
    slack = 1e-9  # the factor of the last step, rounded, is still one
    return min(ends) - slack, max(ends) + slack


def evasions(last: Array, most: Array, limits: Array, count: int, dt: float) -> Array:
    """(E, count, 2) velocities of ways to get out of the way: forwards or back, straight or turning, and then to rest.

    Args:
        last: (2,) velocities now [m/s, rad/s].
        most: (2,) greatest changes in a step.
        limits: (2,) greatest velocities.
        count: of steps.
        dt: [s].
    """
    wanted = np.array([(sense, turn) for sense in (1.0, -1.0) for turn in TURNS]) * limits
    steps = np.arange(1, count + 1)[None, :, None]
    going = min(round(EVADING / dt), count)
    towards = wanted - last
    ways: Array = last + np.sign(towards)[:, None] * np.minimum(np.abs(towards)[:, None], most * steps)
    reached = ways[:, going - 1, None]
    slowing = np.sign(reached) * np.maximum(np.abs(reached) - most * (steps - going), 0.0)
    ways[:, going:] = slowing[:, going:]
    return ways


def followed(pose: Array, last: Array, controls: Array, dt: float) -> Array:
    """(N + 1, 3) poses from ``pose`` on under velocities (N, 2) that are reached at the ends of their steps."""
    return unicycle.rollout(pose, unicycle.ramp(last, controls), dt)
