"""Second derivatives of the quadrotor's defect, weighted and summed: exact, also off the solution.

With q = R' lambda, s = R' v and D = diag(drag) the acceleration of one end weighs in with

    lambda . a = (T/m) q_3 - (1/m) q' D s + what is linear

A turn R Exp(t) makes of q: q - t x q + t x (t x q) / 2, and of s the same. All blocks follow from these two lines.
"""

from __future__ import annotations

from unifg.codegen.calls import local_matrix
from unifg.codegen.jit import compiled
from unifg.lie import so3
from unifg.lie.series import k_slope, k_value
from unifg.models.quadrotor_dynamics import AFTER, AFTER_COLUMN, DISTURBED_AFTER, DISTURBED_COLUMN
from unifg.typing import Array


@compiled
def _attitude(x: Array, after: int, w0: float, w1: float, w2: float, S: Array, to: int) -> None:
    """Write the Hessian of ``w' Log(Exp(-t) E Exp(s))`` for E = R^-1 R+, xi = Log E, t at column 3, s at ``to + 3``.

    With A = Jr^-1(xi) = Jl^-1(xi)', the logarithm moves by A s and -A' t. The derivative of ``w' Jr^-1(xi) s`` as xi
    moves by e is e' N s, with g = xi x (xi x w) and the slope k' / theta,

        N = -[w]x / 2 + slope xi g' + k ((w . xi) I + w xi' - 2 xi w')

    and that of the left one has the other sign at [w]x. So the blocks are sym(A' N), -A N and sym(A N_left).
    """
    A, N, M = local_matrix(3, 3), local_matrix(3, 3), local_matrix(3, 3)
    a, b, c, d = x[3], -x[4], -x[5], -x[6]
    e, f, g, h = x[after + 3], x[after + 4], x[after + 5], x[after + 6]
    xi0 = a * f + b * e + (c * h - d * g)
    xi1 = a * g + c * e + (d * f - b * h)
    xi2 = a * h + d * e + (b * g - c * f)
    factor, _, cotangent = so3.half_log(a * e - b * f - c * g - d * h, xi0, xi1, xi2)
    xi0, xi1, xi2 = factor * xi0, factor * xi1, factor * xi2
    square, inner = xi0 * xi0 + xi1 * xi1 + xi2 * xi2, xi0 * w0 + xi1 * w1 + xi2 * w2
    k, slope = k_value(square, cotangent), k_slope(square, cotangent)
    so3.write_polynomial(0.5, k, xi0, xi1, xi2, A, 0)
    for i in range(3):
        along, weight = (xi0, w0) if i == 0 else ((xi1, w1) if i == 1 else (xi2, w2))
        for j in range(3):
            other, pull = (xi0, w0) if j == 0 else ((xi1, w1) if j == 1 else (xi2, w2))
            N[i, j] = slope * along * (other * inner - pull * square) + k * (weight * other - 2.0 * along * pull)
        N[i, i] += k * inner
    # M = A N_left, then N becomes the right one.
    for which in range(2):
        sign = 0.5 if which == 0 else -1.0
        N[0, 1] -= sign * w2
        N[0, 2] += sign * w1
        N[1, 0] += sign * w2
        N[1, 2] -= sign * w0
        N[2, 0] -= sign * w1
        N[2, 1] += sign * w0
        for i in range(3):
            for j in range(3):
                M[i, j] = A[i, 0] * N[0, j] + A[i, 1] * N[1, j] + A[i, 2] * N[2, j]
        if which == 0:
            for i in range(3):
                for j in range(3):
                    S[3 + i, 3 + j] += 0.5 * (M[i, j] + M[j, i])
    for i in range(3):
        for j in range(3):
            S[3 + i, to + 3 + j] -= M[i, j]
            S[to + 3 + j, 3 + i] -= M[i, j]
            twice = A[0, i] * N[0, j] + A[1, i] * N[1, j] + A[2, i] * N[2, j]
            S[to + 3 + i, to + 3 + j] += 0.5 * twice
            S[to + 3 + j, to + 3 + i] += 0.5 * twice


@compiled
def _pair(S: Array, row: int, column: int, value: float) -> None:
    """Add to an entry off the diagonal and its mirror image."""
    S[row, column] += value
    S[column, row] += value


@compiled
def _end(
    x: Array, at: int, drive: tuple[float, float, float, float, float], pull: tuple[float, float, float], S: Array,
    to: int, rho: int,
) -> None:  # fmt: skip
    """Add the Hessian of ``pull . a`` at one end of the step.

    Args:
        x: variables.
        at: where the state begins.
        drive: thrust, mass and drag.
        pull: weights in the world.
        S: Hessian.
        to: first column of the state.
        rho: column of the mass, and three of the drag after it; -1 where they are given.
    """
    thrust, mass, d0, d1, d2 = drive
    R = local_matrix(3, 3)
    so3.write_matrix(x[at + 3], x[at + 4], x[at + 5], x[at + 6], R, 0)
    v0, v1, v2 = x[at + 7], x[at + 8], x[at + 9]
    q0 = R[0, 0] * pull[0] + R[1, 0] * pull[1] + R[2, 0] * pull[2]
    q1 = R[0, 1] * pull[0] + R[1, 1] * pull[1] + R[2, 1] * pull[2]
    q2 = R[0, 2] * pull[0] + R[1, 2] * pull[1] + R[2, 2] * pull[2]
    s0 = R[0, 0] * v0 + R[1, 0] * v1 + R[2, 0] * v2
    s1 = R[0, 1] * v0 + R[1, 1] * v1 + R[2, 1] * v2
    s2 = R[0, 2] * v0 + R[1, 2] * v1 + R[2, 2] * v2
    per = 1.0 / mass
    # Of the force f = T e3 - D s along the turn: q and -D q, paired with f and s.
    f0, f1, f2 = -per * d0 * s0, -per * d1 * s1, per * (thrust - d2 * s2)
    g0, g1, g2 = -per * d0 * q0, -per * d1 * q1, -per * d2 * q2
    value = q0 * f0 + q1 * f1 + q2 * f2
    t = to + 3
    # Turned twice: (f q' + q f' + g s' + s g') / 2 - (q . f + s . g) I, and once each: -[q]x' D [s]x / m, both ways.
    double = value + s0 * g0 + s1 * g1 + s2 * g2
    e0, e1, e2 = 2.0 * per * d0, 2.0 * per * d1, 2.0 * per * d2
    S[t, t] += f0 * q0 + g0 * s0 - double - e1 * q2 * s2 - e2 * q1 * s1
    S[t + 1, t + 1] += f1 * q1 + g1 * s1 - double - e0 * q2 * s2 - e2 * q0 * s0
    S[t + 2, t + 2] += f2 * q2 + g2 * s2 - double - e0 * q1 * s1 - e1 * q0 * s0
    x01, x02, x12 = q0 * s1 + q1 * s0, q0 * s2 + q2 * s0, q1 * s2 + q2 * s1
    _pair(S, t, t + 1, 0.5 * (f0 * q1 + f1 * q0 + g0 * s1 + g1 * s0) + per * d2 * x01)
    _pair(S, t, t + 2, 0.5 * (f0 * q2 + f2 * q0 + g0 * s2 + g2 * s0) + per * d1 * x02)
    _pair(S, t + 1, t + 2, 0.5 * (f1 * q2 + f2 * q1 + g1 * s2 + g2 * s1) + per * d0 * x12)
    # Turn and velocity: (1/m) ([q]x D - [D q]x) R'; turn and thrust: the turn of q_3.
    u0, u1, u2 = per * (d2 - d1), per * (d0 - d2), per * (d1 - d0)
    for k in range(3):
        a, b, c = R[k, 0], R[k, 1], R[k, 2]
        _pair(S, t, to + 6 + k, u0 * (q2 * b + q1 * c))
        _pair(S, t + 1, to + 6 + k, u1 * (q2 * a + q0 * c))
        _pair(S, t + 2, to + 6 + k, u2 * (q1 * a + q0 * b))
    _pair(S, t, 12, -per * q1)
    _pair(S, t + 1, 12, per * q0)
    if rho < 0:
        return
    m, d = rho, rho + 1
    S[m, m] += 2.0 * value * per * per
    _pair(S, m, 12, -q2 * per * per)
    # Along the turn: q x f of q, s x g of s.
    _pair(S, m, t, per * (q1 * f2 - q2 * f1 + s1 * g2 - s2 * g1))
    _pair(S, m, t + 1, per * (q2 * f0 - q0 * f2 + s2 * g0 - s0 * g2))
    _pair(S, m, t + 2, per * (q0 * f1 - q1 * f0 + s0 * g1 - s1 * g0))
    _pair(S, m, d, q0 * s0 * per * per)
    _pair(S, m, d + 1, q1 * s1 * per * per)
    _pair(S, m, d + 2, q2 * s2 * per * per)
    for k in range(3):
        a, b, c = R[k, 0], R[k, 1], R[k, 2]
        _pair(S, m, to + 6 + k, -per * (g0 * a + g1 * b + g2 * c))
        _pair(S, d, to + 6 + k, -per * q0 * a)
        _pair(S, d + 1, to + 6 + k, -per * q1 * b)
        _pair(S, d + 2, to + 6 + k, -per * q2 * c)
    _pair(S, d, t + 1, per * (s0 * q2 + q0 * s2))
    _pair(S, d, t + 2, -per * (s0 * q1 + q0 * s1))
    _pair(S, d + 1, t, -per * (s1 * q2 + q1 * s2))
    _pair(S, d + 1, t + 2, per * (s1 * q0 + q1 * s0))
    _pair(S, d + 2, t, per * (s2 * q1 + q2 * s1))
    _pair(S, d + 2, t + 1, -per * (s2 * q0 + q2 * s0))


@compiled
def dynamics(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Write the Hessian of w' defect for v = (x, u, x+)."""
    half = -0.5 * p[7]
    S[:] = 0.0
    _attitude(v, AFTER, w[3], w[4], w[5], S, AFTER_COLUMN)
    drive, pull = (v[13], p[0], p[1], p[2], p[3]), (half * w[6], half * w[7], half * w[8])
    _end(v, 0, drive, pull, S, 0, -1)
    _end(v, AFTER, drive, pull, S, AFTER_COLUMN, -1)


@compiled
def disturbed_dynamics(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Write the Hessian of w' defect for v = (x, u, w, mass, drag, wind, updraft, x+)."""
    half = -0.5 * p[0]
    S[:] = 0.0
    _attitude(v, DISTURBED_AFTER, w[3], w[4], w[5], S, DISTURBED_COLUMN)
    drive, pull = (v[13], v[20], v[21], v[22], v[23]), (half * w[6], half * w[7], half * w[8])
    _end(v, 0, drive, pull, S, 0, 19)
    _end(v, DISTURBED_AFTER, drive, pull, S, DISTURBED_COLUMN, 19)
