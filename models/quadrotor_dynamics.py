"""A quadrotor's motion in compiled code: steps of the implicit trapezoid solved in closed form, and RK-MK4.

With the state (p, R, v), the body rates omega and the thrust T, both held over a step of length h, the acceleration is

    a(x) = (T/m) R e3 - g e3 - R D R' v / m + (wind, updraft) + w_a,    D = diag(drag)
"""

from __future__ import annotations

from unifg.codegen.calls import local_vector
from unifg.codegen.jit import compiled
from unifg.lie import so3
from unifg.typing import Array

GRAVITY = 9.81  # [m/s^2]


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
