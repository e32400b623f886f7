"""Sensors of a quadrotor: landmarks on the ground plane, height, and the direction of gravity.

Bearing and range are those of a sensor that is kept level: both are measured in the ground plane, the bearing from
the heading psi, the direction of R e1 seen from above. The heading is undefined where R e1 is vertical, and of no use
near it.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.calls import local_matrix
from unifg.codegen.jit import compiled
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import residual
from unifg.lie import SO3, Rn, so3, wrap_angle
from unifg.models.quadrotor import STATE
from unifg.typing import Array, ArrayLike

__all__ = ["bearing_range", "height", "observe", "offset", "tilt"]


def _bearing_range(x: Array, l: Array, z: Array) -> Array:  # noqa: E741
    """Bearing and range of a landmark, less those measured."""
    w, a, b, c = x[:, 3], x[:, 4], x[:, 5], x[:, 6]
    dx, dy = l[:, 0] - x[:, 0], l[:, 1] - x[:, 1]
    heading = np.arctan2(2.0 * (a * b + w * c), 1.0 - 2.0 * (b * b + c * c))
    bearing = wrap_angle(np.arctan2(dy, dx) - heading - z[:, 0])
    return np.stack([bearing, np.sqrt(dx * dx + dy * dy) - z[:, 1]], axis=1)


@compiled
def _bearing_range_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Hessian of w' (bearing, range).

    The heading is atan2(b, a) of (a, b) = (R_00, R_10). A turn t changes them by -t_2 R_i2 + t_3 R_i1 and, to second
    order, by (t_1 R_i. t - R_i0 t't) / 2; the latter cancels but for its first term.
    """
    R = local_matrix(3, 3)
    so3.write_matrix(v[3], v[4], v[5], v[6], R, 0)
    S[:] = 0.0
    dx, dy = v[10] - v[0], v[11] - v[1]
    square = dx * dx + dy * dy
    turn, pull = w[0] / (square * square), w[1] / (square * math.sqrt(square))
    xx = 2.0 * turn * dx * dy + pull * dy * dy
    xy = turn * (dy * dy - dx * dx) - pull * dx * dy
    yy = -2.0 * turn * dx * dy + pull * dx * dx
    for i in range(2):
        for k in range(2):
            entry = xx if i + k == 0 else (xy if i + k == 1 else yy)
            S[i, k] = S[9 + i, 9 + k] = entry
            S[i, 9 + k] = S[9 + i, k] = -entry
    a, b = R[0, 0], R[1, 0]
    per = -w[0] / (a * a + b * b)
    m1, m2 = a * R[1, 1] - b * R[0, 1], a * R[1, 2] - b * R[0, 2]
    n1, n2 = a * R[0, 1] + b * R[1, 1], a * R[0, 2] + b * R[1, 2]
    S[3, 4] = S[4, 3] = 0.5 * per * m1
    S[3, 5] = S[5, 3] = 0.5 * per * m2
    # (a, b) moves by n along itself and m across, both as (0, -[2], [1]): the angle by -2 n m to second order.
    twice = -2.0 * per / (a * a + b * b)
    S[4, 4] = twice * m2 * n2
    S[5, 5] = twice * m1 * n1
    S[4, 5] = S[5, 4] = -0.5 * twice * (m2 * n1 + m1 * n2)


bearing_range = residual(
    StatedKernel(
        _bearing_range, (STATE, Rn(2), (2,)), 2, name="landmark bearing and range", second=_bearing_range_second
    ),
    about="""``bearing_range(x, l, z)``: bearing [rad], wrapped, and range [m], less z (2,) or (n, 2): (n, 2).

x: quadrotor states. l: (n, 2) landmarks on the ground plane. Not finite where x stands on l.
""",
)


def _height(p: Array, z: Array) -> Array:
    return (p[:, 2] - z)[:, None]


height = residual(
    StatedKernel(_height, (Rn(3), ()), 1, name="height", linear=True),
    about="""``height(p, z)``: p_z - z [m], (n, 1), for positions (n, 3), as ``x.p``, and z a number or (n,).""",
)


def _tilt(R: Array, z: Array) -> Array:
    """R' e3 is the last row of R."""
    w, a, b, c = R[:, 0], R[:, 1], R[:, 2], R[:, 3]
    return np.stack([2.0 * (a * c - w * b), 2.0 * (b * c + w * a), 1.0 - 2.0 * (a * a + b * b)], axis=1) - z


@compiled
def _tilt_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Of w . t x (t x q) / 2: a turn t changes q = R' e3 by q x t."""
    a, x, y, z = v[0], v[1], v[2], v[3]
    q0, q1, q2 = 2.0 * (x * z - a * y), 2.0 * (y * z + a * x), 1.0 - 2.0 * (x * x + y * y)
    inner = w[0] * q0 + w[1] * q1 + w[2] * q2
    S[0, 0], S[1, 1], S[2, 2] = w[0] * q0 - inner, w[1] * q1 - inner, w[2] * q2 - inner
    S[0, 1] = S[1, 0] = 0.5 * (w[0] * q1 + w[1] * q0)
    S[0, 2] = S[2, 0] = 0.5 * (w[0] * q2 + w[2] * q0)
    S[1, 2] = S[2, 1] = 0.5 * (w[1] * q2 + w[2] * q1)


tilt = residual(
    StatedKernel(_tilt, (SO3, (3,)), 3, name="tilt", second=_tilt_second),
    about="""``tilt(R, z)``: R' e3 - z, (n, 3): the vertical as the body sees it, less z (3,) or (n, 3); takes ``x.R``.

With z = (0, 0, 1) it is Ta's cost that keeps the vehicle level: 1/2 |r|^2 = 1 - cos(tilt), whatever the heading.
""",
)


def observe(x: ArrayLike, l: ArrayLike) -> Array:  # noqa: E741
    """Measure landmarks without noise.

    Args:
        x: (10,) state.
        l: (M, 2) landmarks [m].

    Returns:
        (M, 2) bearings [rad] in [-pi, pi) and ranges [m].

    Raises:
        GraphError: on another shape.
    """
    landmarks = np.asarray(l, dtype=np.float64)
    state = np.asarray(x, dtype=np.float64)
    return bearing_range(state, landmarks, np.zeros(2)) if landmarks.shape[:1] != (0,) else np.empty((0, 2))


def offset(x: Array, l: Array, z: Array) -> Array:  # noqa: E741
    """Landmarks l (n, 2) in the axes of SE(2) poses x (n, 3), less where they were seen, z (n, 2): (n, 2) [m]."""
    cosine, sine = np.cos(x[:, 2]), np.sin(x[:, 2])
    dx, dy = l[:, 0] - x[:, 0], l[:, 1] - x[:, 1]
    return np.stack([cosine * dx + sine * dy - z[:, 0], cosine * dy - sine * dx - z[:, 1]], axis=1)
