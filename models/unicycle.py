"""The unicycle: kinematics, tracking and rate residuals (Bazzana et al. 2022, section V).

State x = (px, py, theta) on SE(2), control u = (v, omega) in R2 [m/s, rad/s]. Each residual serves as a soft
factor through ``minimize`` and as a hard constraint through ``constrain``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from unifg.codegen.calls import call_residual, vector
from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import residual
from unifg.lie import SE2, Rn, wrap_angle
from unifg.lie.so2 import wrap
from unifg.modeling.factors import difference
from unifg.typing import Array, ArrayLike

__all__ = ["dynamics", "rate", "rollout", "step", "tracking"]

state = SE2
"""Manifold of the state."""

CONTROL = Rn(2)


def _moves(x: Array, u: Array, dt: Array) -> Array:
    """Change of the pose with the heading at mid-step (eq. 12-14)."""
    along, turn = dt * u[:, 0], dt * u[:, 1]
    middle = x[:, 2] + 0.5 * turn
    return np.stack([along * np.cos(middle), along * np.sin(middle), turn], axis=1)


def _defect(x: Array, u: Array, after: Array, dt: Array) -> Array:
    """x_next - f(x, u) in world axes (eq. 11), heading wrapped; poses differ before anything small is taken off."""
    moves = _moves(x, u, dt)
    turned = wrap_angle(after[:, 2:] - wrap_angle(x[:, 2:] + moves[:, 2:]))
    return np.concatenate([(after[:, :2] - x[:, :2]) - moves[:, :2], turned], axis=1)


def _ramped_defect(x: Array, before: Array, u: Array, after: Array, dt: Array) -> Array:
    """The same of velocities that change steadily from ``before`` to ``u`` over the step."""
    return _defect(x, 0.5 * (before + u), after, dt)


def _deviation(x: Array, reference: Array) -> Array:
    """(p - p_ref, theta - theta_ref) in world axes (eq. 8), heading wrapped."""
    return np.concatenate([x[:, :2] - reference[:, :2], wrap_angle(x[:, 2:] - reference[:, 2:])], axis=1)


moving = StatedKernel(_moves, (SE2, CONTROL, ()), 3, name="moves")
"""``moving(x, u, dt)``: by how much poses change in world axes, (n, 3) [m, m, rad]."""


@compiled
def _advance_all(where: int, x: Array, u: Array, dt: Array, out: Array) -> None:
    """Advance row by row, in order: ``out`` may be ``x`` one row further on; ``where`` is the code of ``moving``."""
    v, moves, nothing = np.empty(5), np.empty(3), np.empty((0, 0))
    for i in range(len(out)):
        copy_to(x[i], v[:3])
        copy_to(u[i], v[3:])
        call_residual(where, v, vector(dt, i, 1), moves, moves, nothing)
        out[i, 0], out[i, 1] = x[i, 0] + moves[0], x[i, 1] + moves[1]
        out[i, 2] = wrap(x[i, 2] + moves[2])


def step(x: Array, u: Array, dt: ArrayLike) -> Array:
    """Advance by one sample with the heading at mid-step (eq. 12-14).

    Args:
        x: (n, 3) poses [m, m, rad].
        u: (n, 2) controls [m/s, rad/s].
        dt: sampling time [s], one or (n,).

    Returns:
        (n, 3) next poses.
    """
    moved = np.empty((max(len(x), len(u)), 3))
    _advance_all(moving.address, _rows(x, moved, 3), _rows(u, moved, 2), _samples(dt, moved), moved)
    return moved


def rollout(start: Array, u: Array, dt: ArrayLike) -> Array:
    """States reached from ``start`` (3,) under controls (n, 2): (n + 1, 3)."""
    states = np.empty((len(u) + 1, 3))
    states[0] = start
    _advance_all(moving.address, states[:-1], _rows(u, states[1:], 2), _samples(dt, states[1:]), states[1:])
    return states


def ramp(last: Array, u: Array) -> Array:
    """Mean velocities (n, 2) of steps at whose ends the velocities are u (n, 2), from ``last`` (2,) on."""
    means: Array = 0.5 * (np.concatenate([last[None], u[:-1]]) + u)
    return means


def _rows(part: ArrayLike, moved: Array, size: int) -> Array:
    """One contiguous row per result."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(part, dtype=np.float64), (len(moved), size)))


def _samples(dt: ArrayLike, moved: Array) -> Array:
    """One sampling time per result."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(dt, dtype=np.float64), len(moved)))


dynamics = residual(
    StatedKernel(_defect, (SE2, CONTROL, SE2, ()), 3, name="dynamics"),
    about="""``dynamics(x, u, x_next, dt)``: x_next - f(x, u), (n, 3) [m, m, rad] (Bazzana eq. 11-14).""",
)

ramped = residual(
    StatedKernel(_ramped_defect, (SE2, CONTROL, CONTROL, SE2, ()), 3, name="ramped dynamics"),
    about="""
``ramped(x, before, u, x_next, dt)``: x_next - f(x, (before + u) / 2), (n, 3) [m, m, rad]: u is reached at the end of
the step, from ``before`` at its beginning, as by a base of limited accelerations.""",
)

tracking = residual(
    StatedKernel(_deviation, (SE2, (3,)), 3, name="tracking"),
    about="""
``tracking(x, reference)``: deviation from a reference pose in world axes, (n, 3) [m, m, rad] (Bazzana eq. 8).""",
)

_change = difference.on(CONTROL).kernel
assert _change is not None
rate = residual(
    replace(_change, name="rate"),
    about="""``rate(u, u_next)``: change of control, (n, 2) [m/s, rad/s].""",
)
