"""Sensors of a quadrotor: landmarks on the ground plane, height, and the direction of gravity.

Bearing and range are those of a sensor that is kept level: both are measured in the ground plane, the bearing from
the heading psi, the direction of R e1 seen from above. The heading is undefined where R e1 is vertical, and of no use
near it.
"""

from __future__ import annotations

import numpy as np

from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import residual
from unifg.lie import SO3, Rn, wrap_angle
from unifg.models.quadrotor import STATE, TAKES
from unifg.typing import Array, ArrayLike

__all__ = ["bearing_range", "height", "observe", "offset", "tilt"]


def _bearing_range(x: Array, l: Array, z: Array) -> Array:  # noqa: E741
    """Bearing and range of a landmark, less those measured."""
    w, a, b, c = x[:, 3], x[:, 4], x[:, 5], x[:, 6]
    dx, dy = l[:, 0] - x[:, 0], l[:, 1] - x[:, 1]
    heading = np.arctan2(2.0 * (a * b + w * c), 1.0 - 2.0 * (b * b + c * c))
    bearing = wrap_angle(np.arctan2(dy, dx) - heading - z[:, 0])
    return np.stack([bearing, np.sqrt(dx * dx + dy * dy) - z[:, 1]], axis=1)


bearing_range = residual(
    StatedKernel(_bearing_range, (STATE, Rn(2), (2,)), 2, name="landmark bearing and range"),
    takes=(TAKES, "m in W", "rad, m in B"),
    about="""``bearing_range(x, l, z)``: bearing [rad], wrapped, and range [m], less z (2,) or (n, 2): (n, 2).

x: quadrotor states. l: (n, 2) landmarks on the ground plane. Not finite where x stands on l.
""",
)


def _height(p: Array, z: Array) -> Array:
    return (p[:, 2] - z)[:, None]


height = residual(
    StatedKernel(_height, (Rn(3), ()), 1, name="height", linear=True),
    takes=("m in W", "m in W"),
    about="""``height(p, z)``: p_z - z [m], (n, 1), for positions (n, 3), as ``x.p``, and z a number or (n,).""",
)


def _tilt(R: Array, z: Array) -> Array:
    """R' e3 is the last row of R."""
    w, a, b, c = R[:, 0], R[:, 1], R[:, 2], R[:, 3]
    return np.stack([2.0 * (a * c - w * b), 2.0 * (b * c + w * a), 1.0 - 2.0 * (a * a + b * b)], axis=1) - z


tilt = residual(
    StatedKernel(_tilt, (SO3, (3,)), 3, name="tilt"),
    takes=("rad in W_T_B", "in B"),
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
