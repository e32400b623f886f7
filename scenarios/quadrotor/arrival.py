"""The prior about what has left the window, in coordinates that turn with the vehicle.

Where the world's origin is and which way it faces, landmarks seen from a vehicle cannot tell. A prior linearised in
the world's coordinates forgets that as soon as its heading is corrected: it claims to know the heading better than it
does, and holds on to the wrong one (Huang, Mourikis and Roumeliotis, Int. J. Robotics Research 29 (2010), on
inconsistent SLAM). Here velocity, wind and landmarks are those seen from the vehicle's place and heading, and attitude
is heading and tilt: a turn of everything changes the heading and nothing else, a shift of everything the position.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

import unifg as fg
from unifg.codegen.calls import local_matrix
from unifg.codegen.jit import compiled
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual
from unifg.lie import so3
from unifg.models import quadrotor
from unifg.typing import Array

STORED, TANGENT = 17, 16  # of state and parameters; landmarks follow


@compiled
def _heading(x: Array, R: Array) -> tuple[float, float, float, float]:
    """Cosine and sine of the heading, its derivatives along the second and third axis of the body; writes R."""
    so3.write_matrix(x[3], x[4], x[5], x[6], R, 0)
    square = R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0]
    length = math.sqrt(square)
    return (
        R[0, 0] / length,
        R[1, 0] / length,
        (R[1, 0] * R[0, 2] - R[0, 0] * R[1, 2]) / square,
        (R[0, 0] * R[1, 1] - R[1, 0] * R[0, 1]) / square,
    )


@compiled
def _arrival(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Difference of state, parameters and landmarks from those of the reference, both seen from their vehicles.

    Behind the reference an offset follows that is taken away.
    """
    derive = len(J) > 0
    if derive:
        J[:] = 0.0
    R = local_matrix(3, 3)
    c0, s0, _, _ = _heading(p, R)
    q0, q1 = R[2, 0], R[2, 1]
    c, s, along, across = _heading(v, R)
    for i in range(3):
        r[i] = v[i] - p[i]
        if derive:
            J[i, i] = 1.0
    r[3] = math.atan2(s * c0 - c * s0, c * c0 + s * s0)
    r[4] = R[2, 0] - q0
    r[5] = R[2, 1] - q1
    if derive:
        J[3, 4], J[3, 5] = along, across
        J[4, 4], J[4, 5] = -R[2, 2], R[2, 1]
        J[5, 3], J[5, 5] = R[2, 2], -R[2, 0]
    r[8] = v[9] - p[9]
    for i in range(7):
        r[9 + i] = v[10 + i] - p[10 + i]
    if derive:
        for i in range(8, 16):
            J[i, i] = 1.0
    for k in range(2 + (len(v) - 17) // 2):  # velocity, wind, landmarks
        at, row = 7, 6
        if k == 1:
            at, row = 14, 13
        elif k > 1:
            at, row = 17 + 2 * (k - 2), 16 + 2 * (k - 2)
        dx, dy, ex, ey = v[at], v[at + 1], p[at], p[at + 1]
        if k > 1:
            dx, dy, ex, ey = dx - v[0], dy - v[1], ex - p[0], ey - p[1]
        x, y = c * dx + s * dy, c * dy - s * dx
        r[row] = x - (c0 * ex + s0 * ey)
        r[row + 1] = y - (c0 * ey - s0 * ex)
        if derive:
            J[row, row], J[row, row + 1], J[row + 1, row], J[row + 1, row + 1] = c, s, -s, c
            J[row, 4], J[row, 5] = y * along, y * across
            J[row + 1, 4], J[row + 1, 5] = -x * along, -x * across
            if k > 1:
                J[row, 0], J[row, 1], J[row + 1, 0], J[row + 1, 1] = -c, -s, s, -c
    for i in range(len(r)):
        r[i] -= p[len(v) + i]


@cache
def arrival(landmarks: int) -> Residual:
    """``arrival(K)(x, mass, drag, wind, updraft, l_1, ..., l_K, reference)``: (n, 16 + 2 K).

    Rows are differences of position (3), heading, the first two entries of R' e3, velocity (3), mass, drag (3), wind
    (2), updraft and landmarks (2 each); velocity, wind and landmarks as seen from the vehicle's place and heading.
    reference: (33 + 4 K,), states, parameters and landmarks in the world side by side, and an offset of the rows. For
    vehicles that lean by less than a right angle.
    """
    marks = [fg.Rn(2)] * landmarks
    parts = (quadrotor.STATE, quadrotor.MASS, quadrotor.DRAG, quadrotor.WIND, quadrotor.UPDRAFT, *marks)
    rows = TANGENT + 2 * landmarks
    kernel = Kernel(_arrival, (*parts, (STORED + 2 * landmarks + rows,)), rows, name="arrival")
    return fg.residual(kernel)


def seen_from_the_vehicle(here: Array, step: Array, information: Array) -> tuple[Array, Array]:
    """Express a joint prior, frozen at ``here``, in the coordinates of :func:`arrival`.

    Args:
        here: (S,) where it was linearised: state, parameters and landmarks.
        step: (D,) from there to its lowest point, a right perturbation.
        information: (D, D) over right perturbations.

    Returns:
        Reference (S + D,), and information (D, D) of the rows of :func:`arrival`.
    """
    reference = np.concatenate([here, np.zeros_like(step)])
    J = np.empty((len(step), len(step)))
    _arrival(reference[: len(here)], reference, np.zeros(0), np.empty(len(step)), J)
    inverse = np.linalg.inv(J)
    information = inverse.T @ information @ inverse
    return np.concatenate([here, J @ step]), 0.5 * (information + information.T)
