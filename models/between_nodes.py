"""Barriers between nodes, from clearances held at the nodes.

Two ends of a step of length L lie outside a ball of radius rho + m. The straight way from one to the other stays
outside the ball of radius rho + e if (rho + m)^2 >= (rho + e)^2 + L^2 / 4. A way that is accelerated by no more than a
leaves the straight one by at most e = a dt^2 / 8. So nodes have to keep

    m = sqrt((rho + e)^2 + L^2 / 4) - rho  <=  e + L^2 / (8 (rho + e))

more than what is to be kept between them: millimetres where v dt / 2 would be centimetres. L is the *relative* travel:
an obstacle that moves adds its own. The same holds for cylinders, discs and segments with a margin, all of which are no
more curved than 1 / rho; what is inside a convex fence loses only e.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.errors import ModelError
from unifg.typing import Array, ArrayLike

__all__ = ["passing", "sag"]


def sag(travel: ArrayLike, radius: ArrayLike, acceleration: float = 0.0, dt: ArrayLike = 0.0) -> Array:
    """m: by how much the clearance between two nodes may be less than at both of them [m].

    Args:
        travel: L, the most that vehicle and obstacle move against each other in a step [m].
        radius: rho of the ball to be kept out of, with the vehicle's own; zero for a point, where m = L / 2 [m].
        acceleration: a, the most of the two against each other [m/s^2].
        dt: length of the step [s].

    Raises:
        ModelError: on a number that is negative or not finite.
    """
    parts = [np.asarray(part, dtype=np.float64) for part in (travel, radius, acceleration, dt)]
    for name, part in zip(("travel", "radius", "acceleration", "dt"), parts, strict=True):
        if not (np.isfinite(part).all() and (part >= 0.0).all()):
            raise ModelError(f"sag: {name} must be finite and not negative, found {part}")
    length, rho, a, step = parts
    bend = a * step**2 / 8.0
    return np.hypot(rho + bend, 0.5 * length) - rho


def passing(p: Array, p_next: Array, centre: Array, centre_next: Array, radius: Any) -> Array:
    """Least ``|p - c| - radius`` on straight ways from one node to the next, (n, M): a check in continuous time.

    It is exact where neither accelerates; ask for a dt^2 / 8 more where they do. A constraint on both nodes at once,
    whose slope jumps nowhere: the nearest point moves along the way, and where it arrives at an end it stays.

    Args:
        p: (n, d) positions at the first node.
        p_next: the same at the next.
        centre: (M, d) or (n, M, d) of the obstacles; of cylinders d = 2, and of positions the first two axes count.
        centre_next: the same at the next node.
        radius: (M,) or (n, M).
    """
    axes = centre.shape[-1]
    start = p[:, None, :axes] - centre
    way = p_next[:, None, :axes] - centre_next - start
    square = np.sum(way * way, axis=2)
    rests = square == 0.0
    share = np.clip(-np.sum(start * way, axis=2) / np.where(rests, 1.0, square), 0.0, 1.0)
    nearest = start + np.where(rests, 0.0, share)[..., None] * way
    least: Array = np.linalg.norm(nearest, axis=2) - radius
    return least
