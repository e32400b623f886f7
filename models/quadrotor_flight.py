"""A quadrotor's flight integrated with RK-MK4, compiled."""

from __future__ import annotations

from unifg.lie import so3
from unifg.machine.calls import local_vector
from unifg.machine.jit import compiled
from unifg.models.quadrotor_dynamics import acceleration
from unifg.typing import Array


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
        ax, ay, az = _at(x, u[3], rho, blow)
        for i in range(3):
            middle[7 + i] = x[7 + i] + 0.5 * h * (ax if i == 0 else (ay if i == 1 else az))
        bx, by, bz = _at(middle, u[3], rho, blow)
        for i in range(3):
            middle[7 + i] = x[7 + i] + 0.5 * h * (bx if i == 0 else (by if i == 1 else bz))
        cx, cy, cz = _at(middle, u[3], rho, blow)
        for i in range(3):
            end[7 + i] = x[7 + i] + h * (cx if i == 0 else (cy if i == 1 else cz))
        dx, dy, dz = _at(end, u[3], rho, blow)
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
def _at(x: Array, thrust: float, rho: Array, blow: Array) -> tuple[float, float, float]:
    """Acceleration of a state."""
    a, b, c = acceleration(x, 0, thrust, rho[0], rho[1], rho[2], rho[3])
    return a + blow[0], b + blow[1], c + blow[2]
