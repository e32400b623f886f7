"""Clearances as plain functions, (n, M) [m]: geofences, one sphere that is itself unknown, several points of a body.

Their derivatives are derived where a graph uses them. Those of any number of discs, cylinders, walls and spheres are in
:mod:`unifg.models.obstacles` and :mod:`unifg.models.avoidance`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from unifg.errors import ModelError
from unifg.factors.residuals import Residual
from unifg.lie import SO3
from unifg.models.quadrotor import P, R
from unifg.typing import Array, ArrayLike

__all__ = ["inside_sphere", "on_body", "polyhedron", "to_point"]


def inside_sphere(p: Array, centre: Array, radius: Any) -> Array:
    """``radius - |p - c|``, (n, 1): a geofence that is a ball (Yang et al. 2025, Fig. 3b), or a disc for two axes.

    p: (n, d) positions; of more axes than the centre the first count. centre: (d,) or (n, d). radius: a number or (n,).
    """
    return np.reshape(radius, (-1, 1)) - _length(p[:, : centre.shape[-1]] - centre)


def polyhedron(x: Array, normals: Array, offsets: Array) -> Array:
    """``b - A x``, (n, m): what is left to each of m planes; a geofence, the X or the X_f of a controller (eq. 4).

    x: (n, d). normals: A (m, d), or (n, m, d); rows of length one make the result metres. offsets: b (m,), or (n, m).
    """
    left: Array = offsets - np.sum(normals * x[:, None, :], axis=2)
    return left


def to_point(p: Array, centre: Array, radius: Any) -> Array:
    """``|p - c| - radius``, (n, 1): from one sphere, or disc, known or estimated.

    p: (n, d) positions or poses, of which as many axes count as the centre has, (n, c) or (c,).

    The like of it for upright cylinders is :data:`unifg.models.avoidance.landmark_clearance`.
    """
    return _length(p[:, : centre.shape[-1]] - centre) - np.reshape(radius, (-1, 1))


def on_body(clearance: Callable[..., Array] | Residual, points: ArrayLike) -> Callable[..., Array]:
    """A clearance of positions at critical points of a body (eq. 15): ``(x, *obstacle)``, (n, K M), point by point.

    Args:
        clearance: ``clearance(p, *obstacle)``, (n, M).
        points: (K, 3) in the body's axes [m].

    Returns:
        Clearance of states (n, 10) of :data:`unifg.models.quadrotor.STATE`: of p + R b for every point b.

    Raises:
        ModelError: when the points are not (K, 3) finite numbers, K >= 1.
    """
    body = np.array(points, dtype=np.float64)
    if body.ndim != 2 or body.shape[1] != 3 or not len(body) or not np.isfinite(body).all():
        raise ModelError(f"critical points are (K, 3) finite numbers, found shape {body.shape}")
    rows = tuple(map(tuple, body.tolist()))

    def of_points(x: Array, *obstacle: Any) -> Array:
        reached = [clearance(x[:, P] + SO3.act(x[:, R], np.array([row])), *obstacle) for row in rows]
        return np.concatenate(reached, axis=1)

    return of_points


def _length(to: Array) -> Array:
    length: Array = np.linalg.norm(to, axis=-1, keepdims=True)
    return length
