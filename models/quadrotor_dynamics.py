"""Compiled dynamics of a quadrotor: the implicit trapezoid with the derivatives of its defect, and RK-MK4.

With the state (p, R, v), the body rates omega and the thrust T, both held over a step of length h, and

    a(x) = (T/m) R e3 - g e3 - R D R' v / m + (wind, updraft) + w_a,    D = diag(drag)

the nine rows are

    p+ - p - h/2 (v + v+),    Log(R^-1 R+) - h (omega + w_omega),    v+ - v - h/2 (a(x) + a(x+))

Every entry that can differ from zero is written by name: a step touches 90 of the 198 or 315 entries.
"""

from __future__ import annotations

from unifg.codegen.calls import local_matrix, local_vector
from unifg.codegen.jit import compiled
from unifg.lie import so3
from unifg.lie.rn import minus
from unifg.lie.series import k_value
from unifg.typing import Array

GRAVITY = 9.81  # [m/s^2]
# Where things stand in the variables of the two kernels, and in their tangents.
AFTER, AFTER_COLUMN = 14, 13
DISTURBED_AFTER, DISTURBED_COLUMN = 27, 26


@compiled
def acceleration(
    x: Array, at: int, thrust: float, mass: float, d0: float, d1: float, d2: float
) -> tuple[float, float, float]:
    """(T/m) R e3 - g e3 - R D R' v / m in the world, of the state that begins at ``x[at]``."""
    w, a, b, c = x[at + 3], -x[at + 4], -x[at + 5], -x[at + 6]
    s0, s1, s2 = so3.rotate(w, a, b, c, x[at + 7], x[at + 8], x[at + 9])
    f0, f1, f2 = so3.rotate(w, -a, -b, -c, -d0 * s0, -d1 * s1, thrust - d2 * s2)
    return f0 / mass, f1 / mass, f2 / mass - GRAVITY


@compiled
def force_along_turn(
    thrust: float, d0: float, d1: float, d2: float, s0: float, s1: float, s2: float
) -> tuple[float, float, float, float, float, float]:
    """Return the entries off the diagonal, row by row, of d (R f) = R M t, the derivative of the force along a turn t.

    The force in the body is f = T e3 - D s, s = R' v, and the turn changes R f by R (t x f + D (t x s)).
    """
    return (
        thrust + (d0 - d2) * s2,
        (d1 - d0) * s1,
        -thrust + (d2 - d1) * s2,
        (d1 - d0) * s0,
        (d2 - d1) * s1,
        (d0 - d2) * s0,
    )


@compiled
def _attitude(x: Array, after: int, rates: tuple[float, float, float], h: float, r: Array, J: Array, to: int) -> None:
    """Write the rows of the attitude, and their derivatives along both attitudes.

    The way back is ``-Jr^-1(xi) Ad(R+^-1 R) = -Jl^-1(xi)``, the transpose of the way ahead.
    """
    w, a, b, c = x[3], -x[4], -x[5], -x[6]
    v, e, f, g = x[after + 3], x[after + 4], x[after + 5], x[after + 6]
    qx = w * e + a * v + (b * g - c * f)
    qy = w * f + b * v + (c * e - a * g)
    qz = w * g + c * v + (a * f - b * e)
    factor, _, cotangent = so3.half_log(w * v - a * e - b * f - c * g, qx, qy, qz)
    qx, qy, qz = factor * qx, factor * qy, factor * qz
    r[3] = qx - h * rates[0]
    r[4] = qy - h * rates[1]
    r[5] = qz - h * rates[2]
    if len(J):
        k = k_value(qx * qx + qy * qy + qz * qz, cotangent)
        xx, yy, zz, xy, xz, yz = k * qx * qx, k * qy * qy, k * qz * qz, k * qx * qy, k * qx * qz, k * qy * qz
        dx, dy, dz = 1.0 - (yy + zz), 1.0 - (xx + zz), 1.0 - (xx + yy)
        qx, qy, qz = 0.5 * qx, 0.5 * qy, 0.5 * qz
        J[3, 3], J[3, 4], J[3, 5] = -dx, -xy - qz, -xz + qy
        J[4, 3], J[4, 4], J[4, 5] = -xy + qz, -dy, -yz - qx
        J[5, 3], J[5, 4], J[5, 5] = -xz - qy, -yz + qx, -dz
        J[3, to + 3], J[3, to + 4], J[3, to + 5] = dx, xy - qz, xz + qy
        J[4, to + 3], J[4, to + 4], J[4, to + 5] = xy + qz, dy, yz - qx
        J[5, to + 3], J[5, to + 4], J[5, to + 5] = xz - qy, yz + qx, dz
        J[3, 9] = J[4, 10] = J[5, 11] = -h


@compiled
def _end(
    x: Array, at: int, drive: tuple[float, float, float, float, float], half: float, r: Array, J: Array, to: int,
    rho: int,
) -> None:  # fmt: skip
    """Subtract ``half`` times the acceleration at one end of the step from the rows of the velocity.

    Args:
        x: variables.
        at: where the state begins.
        drive: thrust, mass and drag.
        half: h/2.
        r: defect.
        J: its derivatives.
        to: first column of the state.
        rho: column of the mass, and three of the drag after it; -1 where they are given.
    """
    thrust, mass, d0, d1, d2 = drive
    if len(J) == 0:
        ax, ay, az = acceleration(x, at, thrust, mass, d0, d1, d2)
        r[6] -= half * ax
        r[7] -= half * ay
        r[8] -= half * az
        return
    R = local_matrix(3, 3)
    so3.write_matrix(x[at + 3], x[at + 4], x[at + 5], x[at + 6], R, 0)
    v0, v1, v2 = x[at + 7], x[at + 8], x[at + 9]
    scale = half / mass
    s0 = R[0, 0] * v0 + R[1, 0] * v1 + R[2, 0] * v2
    s1 = R[0, 1] * v0 + R[1, 1] * v1 + R[2, 1] * v2
    s2 = R[0, 2] * v0 + R[1, 2] * v1 + R[2, 2] * v2
    f0, f1, f2 = -d0 * s0, -d1 * s1, thrust - d2 * s2  # force in the body
    t01, t02, t10, t12, t20, t21 = force_along_turn(thrust, d0, d1, d2, s0, s1, s2)
    for i in range(3):
        a, b, c = scale * R[i, 0], scale * R[i, 1], scale * R[i, 2]
        force = a * f0 + b * f1 + c * f2
        row = 6 + i
        r[row] -= force
        J[row, to + 3] = -(b * t10 + c * t20)
        J[row, to + 4] = -(a * t01 + c * t21)
        J[row, to + 5] = -(a * t02 + b * t12)
        J[row, 12] -= c
        for k in range(3):
            J[row, to + 6 + k] += a * d0 * R[k, 0] + b * d1 * R[k, 1] + c * d2 * R[k, 2]
        if rho >= 0:
            J[row, rho] += force / mass
            J[row, rho + 1] += a * s0
            J[row, rho + 2] += b * s1
            J[row, rho + 3] += c * s2
    r[8] += half * GRAVITY


@compiled
def dynamics(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Defect between v = (x, u, x+), p = (mass, drag, wind, updraft, h)."""
    h = p[7]
    half = 0.5 * h
    _straight(v, AFTER, (p[4], p[5], p[6]), h, r, J, AFTER_COLUMN)
    _attitude(v, AFTER, (v[10], v[11], v[12]), h, r, J, AFTER_COLUMN)
    drive = v[13], p[0], p[1], p[2], p[3]
    _end(v, 0, drive, half, r, J, 0, -1)
    _end(v, AFTER, drive, half, r, J, AFTER_COLUMN, -1)


@compiled
def disturbed_dynamics(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Defect between v = (x, u, w, mass, drag, wind, updraft, x+), p = (h,)."""
    h = p[0]
    half = 0.5 * h
    blow = v[24] + v[17], v[25] + v[18], v[26] + v[19]
    _straight(v, DISTURBED_AFTER, blow, h, r, J, DISTURBED_COLUMN)
    rates = v[10] + v[14], v[11] + v[15], v[12] + v[16]
    _attitude(v, DISTURBED_AFTER, rates, h, r, J, DISTURBED_COLUMN)
    if len(J):
        for i in range(3):
            J[3 + i, 13 + i] = J[6 + i, 16 + i] = J[6 + i, 23 + i] = -h
    drive = v[13], v[20], v[21], v[22], v[23]
    _end(v, 0, drive, half, r, J, 0, 19)
    _end(v, DISTURBED_AFTER, drive, half, r, J, DISTURBED_COLUMN, 19)


@compiled
def _straight(x: Array, after: int, blow: tuple[float, float, float], h: float, r: Array, J: Array, to: int) -> None:
    """Write the rows of the position, begin those of the velocity with what does not depend on the state; clear J."""
    half = 0.5 * h
    for i in range(3):
        r[i] = minus(minus(x[after + i], x[i]), half * (x[7 + i] + x[after + 7 + i]))
        r[6 + i] = x[after + 7 + i] - x[7 + i] - h * blow[i]
    if len(J):
        J[:] = 0.0
        for i in range(3):
            J[i, i] = J[6 + i, 6 + i] = -1.0
            J[i, to + i] = J[6 + i, to + 6 + i] = 1.0
            J[i, 6 + i] = J[i, to + 6 + i] = -half


@compiled
def advance(x: Array, u: Array, h: float, rho: Array, out: Array) -> None:
    """Write the state after one step: the zero of the defect.

    The velocity at the end enters only through its drag, which is diagonal in the body, so that it is solved for
    there.
    """
    mass, half = rho[0], 0.5 * h
    _, cosine, s = so3.half_turn(h * u[0], h * u[1], h * u[2])
    so3.write_product(x[3], x[4], x[5], x[6], cosine, s * h * u[0], s * h * u[1], s * h * u[2], out, 3)
    ax, ay, az = acceleration(x, 0, u[3], mass, rho[1], rho[2], rho[3])
    w, a, b, c = out[3], out[4], out[5], out[6]
    tx, ty, tz = so3.rotate(w, a, b, c, 0.0, 0.0, u[3] / mass)
    bx = x[7] + half * (ax + tx) + h * rho[4]
    by = x[8] + half * (ay + ty) + h * rho[5]
    bz = x[9] + half * (az + tz - GRAVITY) + h * rho[6]
    s0, s1, s2 = so3.rotate(w, -a, -b, -c, bx, by, bz)
    k = half / mass
    s0, s1, s2 = s0 / (1.0 + k * rho[1]), s1 / (1.0 + k * rho[2]), s2 / (1.0 + k * rho[3])
    out[7], out[8], out[9] = so3.rotate(w, a, b, c, s0, s1, s2)
    for i in range(3):
        out[i] = x[i] + half * (x[7 + i] + out[7 + i])


@compiled
def advance_all(x: Array, u: Array, h: Array, rho: Array, out: Array) -> None:
    """Advance row by row, in order: ``out`` may be ``x`` one row further on."""
    for i in range(len(out)):
        advance(x[i], u[i], h[i], rho, out[i])


# ---------------------------------------------------------------- other integrators


@compiled
def integrate(x: Array, u: Array, w: Array, rho: Array, h: float, steps: int) -> None:
    """Move the state x (10,) by steps of length h under a control, a noise and parameters that are held."""
    half, turn, blow = local_vector(4), local_vector(4), local_vector(3)
    middle, end = local_vector(10), local_vector(10)
    wx, wy, wz = u[0] + w[0], u[1] + w[1], u[2] + w[2]
    _, cosine, s = so3.half_turn(0.5 * h * wx, 0.5 * h * wy, 0.5 * h * wz)
    so3.write(cosine, 0.5 * h * s * wx, 0.5 * h * s * wy, 0.5 * h * s * wz, half, 0)
    so3.compose(half, half, turn)
    for i in range(3):
        blow[i] = rho[4 + i] + w[3 + i]
    for _ in range(steps):
        so3.write_product(x[3], x[4], x[5], x[6], half[0], half[1], half[2], half[3], middle, 3)
        so3.write_product(x[3], x[4], x[5], x[6], turn[0], turn[1], turn[2], turn[3], end, 3)
        ax, ay, az = _blown(x, u[3], rho, blow)
        for i in range(3):
            middle[7 + i] = x[7 + i] + 0.5 * h * (ax if i == 0 else (ay if i == 1 else az))
        bx, by, bz = _blown(middle, u[3], rho, blow)
        for i in range(3):
            middle[7 + i] = x[7 + i] + 0.5 * h * (bx if i == 0 else (by if i == 1 else bz))
        cx, cy, cz = _blown(middle, u[3], rho, blow)
        for i in range(3):
            end[7 + i] = x[7 + i] + h * (cx if i == 0 else (cy if i == 1 else cz))
        dx, dy, dz = _blown(end, u[3], rho, blow)
        # Positions: the stages' velocities are v, v + h a/2, v + h b/2 and v + h c.
        x[0] += h * (x[7] + h * (ax + bx + cx) / 6.0)
        x[1] += h * (x[8] + h * (ay + by + cy) / 6.0)
        x[2] += h * (x[9] + h * (az + bz + cz) / 6.0)
        x[7] += h * (ax + 2.0 * (bx + cx) + dx) / 6.0
        x[8] += h * (ay + 2.0 * (by + cy) + dy) / 6.0
        x[9] += h * (az + 2.0 * (bz + cz) + dz) / 6.0
        for i in range(3, 7):
            x[i] = end[i]


@compiled
def _blown(x: Array, thrust: float, rho: Array, blow: Array) -> tuple[float, float, float]:
    """Acceleration of a state."""
    a, b, c = acceleration(x, 0, thrust, rho[0], rho[1], rho[2], rho[3])
    return a + blow[0], b + blow[1], c + blow[2]
