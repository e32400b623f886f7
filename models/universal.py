"""Any vehicle that is turned by rates and pushed by a force: the universal dynamics of Yang et al. 2025, III-C.1.

States are those of :mod:`unifg.models.quadrotor`, x = {p, R, v}; a control is u = (omega, a): rates [rad/s] and what an
accelerometer would measure [m/s^2], both in the body's axes, which controllers below hold (eq. 9):

    p' = v,   R' = R hat(omega),   v' = R a - g e3

With u held over a step, eq. 10 has the exact attitude, and position and velocity as if the attitude of its begin were
held. Its noise is that of u, six numbers in nine rows (eq. 11): rows of position and velocity share their noise,
r_p = dt/2 r_v, and the covariance has rank six. No inverse of it exists. So three rows are an equality,
:data:`consistency`, and six are costs, :data:`increments`; or all nine vanish, :data:`dynamics`, with u + w in the
place of u where a noise is wanted.

The other factors of the paper are there already: control rates (eq. 13) are ``fg.difference`` of neighbouring controls,
the reference on the manifold (eq. 14) is ``fg.prior``, hard control limits are ``graph.bound``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.errors import ModelError
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import residual
from unifg.lie import SO3, Rn
from unifg.models import quadrotor
from unifg.models.quadrotor import UP, P, R, V
from unifg.typing import Array, ArrayLike

CONTROL = Rn(6)
"""Rates [rad/s], 3, and accelerations without gravity [m/s^2], 3, along the axes of the body."""


def field(x: Array, u: Array) -> Array:
    """F, (n, 9): x' in the tangent space of :data:`unifg.models.quadrotor.STATE` (eq. 9, 16)."""
    return np.concatenate([x[:, V], u[:, :3], SO3.act(x[:, R], u[:, 3:]) - quadrotor.GRAVITY * UP], axis=1)


def _defect(x: Array, u: Array, x_next: Array, dt: Any) -> Array:
    h = np.reshape(dt, (-1, 1))
    back, fall = SO3.inverse(x[:, R]), quadrotor.GRAVITY * UP
    moved = SO3.act(back, x_next[:, P] - x[:, P] - h * x[:, V] + 0.5 * h * h * fall) - 0.5 * h * h * u[:, 3:]
    turned = SO3.log(SO3.compose(back, x_next[:, R])) - h * u[:, :3]
    sped = SO3.act(back, x_next[:, V] - x[:, V] + h * fall) - h * u[:, 3:]
    return np.concatenate([moved, turned, sped], axis=1)


def _consistency(x: Array, x_next: Array, dt: Any) -> Array:
    return x_next[:, P] - x[:, P] - 0.5 * np.reshape(dt, (-1, 1)) * (x[:, V] + x_next[:, V])


def _increments(x: Array, u: Array, x_next: Array, dt: Any) -> Array:
    h = np.reshape(dt, (-1, 1))
    back = SO3.inverse(x[:, R])
    turned = SO3.log(SO3.compose(back, x_next[:, R])) / h - u[:, :3]
    sped = SO3.act(back, (x_next[:, V] - x[:, V]) / h + quadrotor.GRAVITY * UP) - u[:, 3:]
    return np.concatenate([turned, sped], axis=1)


STEP = quadrotor.STATE, CONTROL, quadrotor.STATE, ()
_TAKES = quadrotor.TAKES, "rad/s, rad/s, rad/s, m/s^2, m/s^2, m/s^2 in B", quadrotor.TAKES, "s"

dynamics = residual(
    StatedKernel(_defect, STEP, 9, name="universal dynamics"),
    takes=_TAKES,
    about="""
``dynamics(x, u, x_next, dt)``: eq. 10, (n, 9): position [m], attitude [rad] and velocity [m/s] in body axes.""",
)

consistency = residual(
    StatedKernel(_consistency, (quadrotor.STATE, quadrotor.STATE, ()), 3, name="consistency"),
    takes=(quadrotor.TAKES, quadrotor.TAKES, "s"),
    about="""
``consistency(x, x_next, dt)``: p_next - p - dt (v + v_next) / 2, (n, 3) [m]; what no noise explains, an equality.""",
)

increments = residual(
    StatedKernel(_increments, STEP, 6, name="increments"),
    takes=_TAKES,
    about="""``increments(x, u, x_next, dt)``: rows of attitude and velocity of :data:`dynamics` per second, (n, 6).

Rates [rad/s] and accelerations [m/s^2]: with ``sigma=[sigma_omega] * 3 + [sigma_a] * 3``, and :data:`consistency` as an
equality, this is eq. 10 under the covariance of eq. 11.
""",
)


def covariance(dt: float, sigma_a: float, sigma_omega: float) -> Array:
    """(9, 9) covariance of :data:`dynamics` under noise of the control (eq. 11); its rank is six.

    Args:
        dt: [s].
        sigma_a: standard deviation of accelerations [m/s^2].
        sigma_omega: of rates [rad/s].
    """
    eye, none = np.eye(3), np.zeros((3, 3))
    spread = np.block(
        [[0.5 * dt * dt * sigma_a * eye, none], [none, dt * sigma_omega * eye], [dt * sigma_a * eye, none]]
    )
    return np.asarray(spread @ spread.T)


def excess(u: Array, lower: Array, upper: Array) -> Array:
    """``max(u - upper, 0) + max(lower - u, 0)``, (n, m): how far controls are beyond their limits (eq. 12)."""
    return np.maximum(u - upper, 0.0) + np.maximum(lower - u, 0.0)


def step(x: Array, u: Array, dt: Any) -> Array:
    """(n, 10) states in which :data:`dynamics` of a step vanish."""
    h = np.reshape(dt, (-1, 1))
    sped = SO3.act(x[:, R], u[:, 3:]) - quadrotor.GRAVITY * UP
    moved = x[:, P] + h * x[:, V] + 0.5 * h * h * sped
    turned = SO3.compose(x[:, R], SO3.exp(h * u[:, :3]))
    return np.concatenate([moved, turned, x[:, V] + h * sped], axis=1)


def hover(x: ArrayLike) -> Array:
    """(n, 6) controls that hold velocities and attitudes (n, 10): no rate, gravity taken back.

    Raises:
        ModelError: on another shape.
    """
    states = np.asarray(x, dtype=np.float64)
    if states.ndim != 2 or states.shape[1] != quadrotor.STATE.storage:
        raise ModelError(f"states have shape (n, {quadrotor.STATE.storage}), found {states.shape}")
    held = SO3.act(SO3.inverse(states[:, R]), quadrotor.GRAVITY * np.broadcast_to(UP, (len(states), 3)))
    return np.concatenate([np.zeros((len(states), 3)), held], axis=1)
