"""Coming to rest, or out of the way, without a solver and within the accelerations of a base.

Velocities change steadily over a tick, by ``most`` = acceleration times duration at the most. A plan that ends at rest
and keeps to that can be left at any time for :func:`stopped`, which comes to rest sooner along the same path.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.models import unicycle
from unifg.models.planar import Base
from unifg.typing import Array

EVADING = 1.0  # [s] for which the robot evades before it brakes
TURNS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # turning rates tried, in shares of the greatest


def stopped(last: Array, plan: Array, most: Array, count: int, base: Base = unicycle.BASE) -> Array:
    """Controls (count, m) that bring a base to rest along the path of a plan, as soon as its accelerations allow.

    The plan is driven more and more slowly, all velocities by the same factor, so that the path keeps its shape; a
    steering angle is that of the place on the path. The factor that was good for one step is good for the next, because
    the plan itself keeps the accelerations; the least that they allow is taken. Where the plan does not go on from the
    velocities now, all fade by themselves.

    Args:
        last: (m,) controls now.
        plan: (k, m) those that would come next.
        most: (m,) greatest changes in a step.
        count: of steps.
        base: that moves.
    """
    resting = base.resting.tolist()
    now, change = last.tolist(), most.tolist()
    end = plan[-1] if len(plan) else last
    ahead = [now, *plan.tolist(), np.where(base.resting, 0.0, end).tolist()]
    controls, factor, progress = np.zeros((count, base.size)), 1.0, 0.0
    for k in range(count):
        if all(abs(v) <= d for v, d, falls in zip(now, change, resting, strict=True) if falls):
            controls[k:, ~base.resting] = np.array(now)[~base.resting]
            break
        progress = min(progress + factor, len(ahead) - 1.0)
        at = min(int(progress), len(ahead) - 2)
        share = progress - at
        wanted = [(1.0 - share) * a + share * b for a, b in zip(ahead[at], ahead[at + 1], strict=True)]
        ends = [
            _factors(*each) for each, falls in zip(zip(now, wanted, change, strict=True), resting, strict=True) if falls
        ]
        low, high = max(*(least for least, _ in ends), 0.0), min(*(greatest for _, greatest in ends), factor)
        if low <= high:
            factor = low
            now = [factor * w if falls else w for w, falls in zip(wanted, resting, strict=True)]
        else:
            now = [v - min(max(v, -d), d) if falls else v for v, d, falls in zip(now, change, resting, strict=True)]
        controls[k] = now
    return controls


def _factors(now: float, wanted: float, most: float) -> tuple[float, float]:
    """Between which factors on a velocity that is wanted it differs by at most so much from that of now."""
    if wanted == 0.0:
        return (0.0, math.inf) if abs(now) <= most else (math.inf, -math.inf)
    ends = (now - most) / wanted, (now + most) / wanted
    slack = 1e-9  # the factor of the last step, rounded, is still one
    return min(ends) - slack, max(ends) + slack


def evasions(last: Array, most: Array, limits: Array, count: int, dt: float, base: Base = unicycle.BASE) -> Array:
    """(E, count, m) controls of ways to get out of the way: forwards or back, straight or turning, and then to rest.

    A base that slides also goes sideways, and aslant.

    Args:
        last: (m,) controls now.
        most: (m,) greatest changes in a step.
        limits: (m,) greatest controls.
        count: of steps.
        dt: [s].
        base: that moves.
    """
    aside = [(0.0,)] if base.slides else [()]
    ways = [(sense, *none, turn) for sense in (1.0, -1.0) for none in aside for turn in TURNS]
    if base.slides:
        ways += [(ahead, left, 0.0) for ahead in (-1.0, 0.0, 1.0) for left in (-1.0, 1.0)]
    wanted = np.array(ways) * limits
    steps = np.arange(1, count + 1)[None, :, None]
    going = min(round(EVADING / dt), count)
    towards = wanted - last
    driven: Array = last + np.sign(towards)[:, None] * np.minimum(np.abs(towards)[:, None], most * steps)
    reached = driven[:, going - 1, None]
    slowing = np.sign(reached) * np.maximum(np.abs(reached) - most * (steps - going), 0.0)
    driven[:, going:] = np.where(base.resting, slowing, reached)[:, going:]
    return driven
