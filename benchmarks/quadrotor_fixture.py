"""A quadrotor on {p, R, v} for the control cases: dynamics defect and sphere clearance as compiled kernels.

State: position p [m] and velocity v [m/s] in the world, z up, and attitude R = world_R_body. Control: body rates w
[rad/s] and collective thrust T per mass [m/s^2]. One step of length dt, trapezoidal in everything but the rotation:

    R+ = R Exp(dt w),   v+ = v + dt (T (R e3 + R+ e3) / 2 - g e3),   p+ = p + dt (v + v+) / 2
"""

from __future__ import annotations

import math

import numpy as np

import unifg as fg
from unifg.calls import local_matrix, local_vector, vector
from unifg.jit import compiled
from unifg.kernels import Kernel
from unifg.lie.scalar import so3
from unifg.residuals import residual
from unifg.typing import Array

GRAVITY = 9.81  # [m/s^2]
STATE = fg.Product(p=fg.Rn(3), R=fg.SO3, v=fg.Rn(3))
CONTROL = fg.Rn(4)


@compiled
def advance(x: Array, u: Array, dt: float, out: Array) -> None:
    """Write the next state of one quadrotor."""
    turn, R, after = local_vector(3), local_matrix(3, 3), local_matrix(3, 3)
    step = local_vector(4)
    for i in range(3):
        turn[i] = dt * u[i]
    so3.exp(turn, step)
    so3.compose(vector(x, 3, 4), step, vector(out, 3, 4))
    so3.matrix(vector(x, 3, 4), R)
    so3.matrix(vector(out, 3, 4), after)
    for i in range(3):
        gravity = GRAVITY if i == 2 else 0.0
        out[7 + i] = x[7 + i] + dt * (0.5 * u[3] * (R[i, 2] + after[i, 2]) - gravity)
        out[i] = x[i] + 0.5 * dt * (x[7 + i] + out[7 + i])


@compiled
def _dynamics(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Write the defects of position, attitude (as a rotation vector) and velocity."""
    dt, thrust = p[0], v[13]
    turn, step, moved, error = local_vector(3), local_vector(4), local_vector(4), local_vector(4)
    R, after = local_matrix(3, 3), local_matrix(3, 3)
    for i in range(3):
        turn[i] = dt * v[10 + i]
    so3.exp(turn, step)
    so3.compose(vector(v, 3, 4), step, moved)
    so3.between(moved, vector(v, 17, 4), error)
    so3.log(error, vector(r, 3, 3))
    so3.matrix(vector(v, 3, 4), R)
    so3.matrix(vector(v, 17, 4), after)
    for i in range(3):
        gravity = GRAVITY if i == 2 else 0.0
        r[i] = v[14 + i] - v[i] - 0.5 * dt * (v[7 + i] + v[21 + i])
        r[6 + i] = v[21 + i] - v[7 + i] - dt * (0.5 * thrust * (R[i, 2] + after[i, 2]) - gravity)
    if len(J) == 0:
        return
    inverse, right, E = local_matrix(3, 3), local_matrix(3, 3), local_matrix(3, 3)
    so3.right_jacobian_inverse(vector(r, 3, 3), inverse)
    so3.right_jacobian(turn, right)
    so3.matrix(error, E)
    for a in range(9):
        for d in range(22):
            J[a, d] = 0.0
    half = 0.5 * dt * thrust
    for i in range(3):
        J[i, i], J[i, 6 + i], J[i, 13 + i], J[i, 19 + i] = -1.0, -0.5 * dt, 1.0, -0.5 * dt
        J[6 + i, 6 + i], J[6 + i, 19 + i] = -1.0, 1.0
        J[6 + i, 12] = -0.5 * dt * (R[i, 2] + after[i, 2])
        J[6 + i, 3], J[6 + i, 4] = half * R[i, 1], -half * R[i, 0]
        J[6 + i, 16], J[6 + i, 17] = half * after[i, 1], -half * after[i, 0]
    for i in range(3):
        for k in range(3):
            back = rate = 0.0
            for j in range(3):
                # Row i of the inverse times R+' R, and times E' Jr(dt w).
                relative = after[0, j] * R[0, k] + after[1, j] * R[1, k] + after[2, j] * R[2, k]
                turned = E[0, j] * right[0, k] + E[1, j] * right[1, k] + E[2, j] * right[2, k]
                back += inverse[i, j] * relative
                rate += inverse[i, j] * turned
            J[3 + i, 3 + k], J[3 + i, 9 + k], J[3 + i, 16 + k] = -back, -dt * rate, inverse[i, k]


@compiled
def _tilt(at: int, R: Array, x: float, y: float, z: float, S: Array) -> None:
    """Add the Hessian of (x, y, z)' R Exp(d) e3, whose columns begin at ``at``, and its mixed part with the thrust."""
    bx = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
    by = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
    bz = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
    S[at, at] -= bz
    S[at + 1, at + 1] -= bz
    S[at, at + 2] += 0.5 * bx
    S[at + 2, at] += 0.5 * bx
    S[at + 1, at + 2] += 0.5 * by
    S[at + 2, at + 1] += 0.5 * by


@compiled
def _dynamics_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Hessian of w' r; for the attitude at a defect of zero, and in the rates to fourth order of |dt w|."""
    dt, thrust = p[0], v[13]
    R, after, B, F = local_matrix(3, 3), local_matrix(3, 3), local_matrix(3, 3), local_matrix(3, 3)
    turn, step = local_vector(3), local_vector(4)
    so3.matrix(vector(v, 3, 4), R)
    so3.matrix(vector(v, 17, 4), after)
    for i in range(22):
        for k in range(22):
            S[i, k] = 0.0
    half = 0.5 * dt * thrust
    _tilt(3, R, -half * w[6], -half * w[7], -half * w[8], S)
    _tilt(16, after, -half * w[6], -half * w[7], -half * w[8], S)
    for which in range(2):
        M, at = (R, 3) if which == 0 else (after, 16)
        bx = M[0, 0] * w[6] + M[1, 0] * w[7] + M[2, 0] * w[8]
        by = M[0, 1] * w[6] + M[1, 1] * w[7] + M[2, 1] * w[8]
        S[at, 12] = S[12, at] = 0.5 * dt * by
        S[at + 1, 12] = S[12, at + 1] = -0.5 * dt * bx
    # Log(Exp(a) Exp(b) Exp(c)) = a + b + c + (a x b + a x c + b x c) / 2: a = -dt Jr(dt w) dw, b = -B d, c = d+.
    for i in range(3):
        turn[i] = -dt * v[10 + i]
    so3.exp(turn, step)
    so3.matrix(step, B)
    for i in range(3):
        turn[i] = -turn[i]
    so3.right_jacobian(turn, F)
    x, y, z = w[3], w[4], w[5]
    for i in range(3):
        # Rows of F' K and B' K with K = -[w]x / 2, as in w'(a x b) / 2 = a' K b.
        fx, fy, fz = -dt * F[0, i], -dt * F[1, i], -dt * F[2, i]
        f0, f1, f2 = 0.5 * (fz * y - fy * z), 0.5 * (fx * z - fz * x), 0.5 * (fy * x - fx * y)
        bx, by, bz = -B[0, i], -B[1, i], -B[2, i]
        b0, b1, b2 = 0.5 * (bz * y - by * z), 0.5 * (bx * z - bz * x), 0.5 * (by * x - bx * y)
        S[9 + i, 16], S[9 + i, 17], S[9 + i, 18] = f0, f1, f2
        S[3 + i, 16], S[3 + i, 17], S[3 + i, 18] = b0, b1, b2
        for k in range(3):
            S[9 + i, 3 + k] = -(f0 * B[0, k] + f1 * B[1, k] + f2 * B[2, k])
    # Second derivatives of a: -d x (t x d) / 6 + (n'd) (t'd) / 12 for t = dt w and n = t x (attitude multipliers).
    n0, n1, n2 = turn[1] * z - turn[2] * y, turn[2] * x - turn[0] * z, turn[0] * y - turn[1] * x
    inner = turn[0] * x + turn[1] * y + turn[2] * z
    for i in range(3):
        normal = n0 if i == 0 else (n1 if i == 1 else n2)
        for k in range(3):
            other = n0 if k == 0 else (n1 if k == 1 else n2)
            twist = (w[3 + i] * turn[k] + w[3 + k] * turn[i]) / 12.0 - (inner / 6.0 if i == k else 0.0)
            S[9 + i, 9 + k] = dt * dt * (twist + (normal * turn[k] + other * turn[i]) / 24.0)
            S[16 + k, 9 + i] = S[9 + i, 16 + k]
            S[16 + k, 3 + i] = S[3 + i, 16 + k]
            S[3 + k, 9 + i] = S[9 + i, 3 + k]


@compiled
def _clearance(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Write |p - c| - radius for all spheres; p holds M centres, then M radii."""
    count = len(r)
    for k in range(count):
        x, y, z = v[0] - p[3 * k], v[1] - p[3 * k + 1], v[2] - p[3 * k + 2]
        distance = math.sqrt(x * x + y * y + z * z)
        r[k] = distance - p[3 * count + k]
        if len(J):
            inverse = 1.0 / max(distance, 1e-9)
            J[k, 0], J[k, 1], J[k, 2] = inverse * x, inverse * y, inverse * z


@compiled
def _clearance_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Hessian of w' (|p - c| - radius)."""
    for i in range(3):
        for k in range(3):
            S[i, k] = 0.0
    for j in range(len(w)):
        x, y, z = v[0] - p[3 * j], v[1] - p[3 * j + 1], v[2] - p[3 * j + 2]
        distance = math.sqrt(x * x + y * y + z * z)
        if distance < 1e-9:
            continue
        x, y, z, scale = x / distance, y / distance, z / distance, w[j] / distance
        S[0, 0] += scale * (1.0 - x * x)
        S[0, 1] -= scale * x * y
        S[0, 2] -= scale * x * z
        S[1, 1] += scale * (1.0 - y * y)
        S[1, 2] -= scale * y * z
        S[2, 2] += scale * (1.0 - z * z)
    S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]


dynamics = residual(Kernel(_dynamics, (STATE, CONTROL, STATE, 0), 9, name="quadrotor", second=_dynamics_second))
"""``dynamics(x, u, x_next, dt)``: defects of position [m], attitude [rad] and velocity [m/s], (n, 9)."""

clearance = residual(
    Kernel(
        _clearance,
        (fg.Rn(3), 2, 1),
        lambda centre, radius: centre[0],
        name="sphere clearance",
        second=_clearance_second,
    )
)
"""``clearance(p, centre, radius)``: |p - c| - r [m] for centres (M, 3) and radii (M,), (n, M)."""


def step(x: Array, u: Array, dt: float) -> Array:
    """(10,) state after one step."""
    out = np.empty(10)
    advance(np.ascontiguousarray(x), np.ascontiguousarray(u), dt, out)
    return out
