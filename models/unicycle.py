"""The unicycle: kinematics, tracking and rate residuals (Bazzana et al. 2022, section V).

State x = (px, py, theta) on SE(2), control u = (v, omega) in R2 [m/s, rad/s]. Each residual serves as a soft
factor through ``minimize`` and as a hard constraint through ``constrain``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import residual
from unifg.lie import SE2, wrap_angle
from unifg.models.planar import POSE, base_of
from unifg.typing import Array

__all__ = ["dynamics", "rate", "rollout", "step", "tracking"]

state = SE2
"""Manifold of the state."""

CONTROL = "m/s, rad/s in B"  # units and frame of a control
BASE = base_of("unicycle")
moving, step, rollout, followed = BASE.moving, BASE.step, BASE.rollout, BASE.followed


def _deviation(x: Array, reference: Array) -> Array:
    """(p - p_ref, theta - theta_ref) in world axes (eq. 8), heading wrapped."""
    return np.concatenate([x[:, :2] - reference[:, :2], wrap_angle(x[:, 2:] - reference[:, 2:])], axis=1)


assert BASE.dynamics.kernel is not None and BASE.ramped.kernel is not None and BASE.rate.kernel is not None
dynamics = residual(
    BASE.dynamics.kernel,
    takes=(POSE, CONTROL, POSE, "s"),
    about="""``dynamics(x, u, x_next, dt)``: x_next - f(x, u), (n, 3) [m, m, rad] (Bazzana eq. 11-14).""",
)

ramped = residual(
    BASE.ramped.kernel,
    takes=(POSE, CONTROL, CONTROL, POSE, "s"),
    about="""
``ramped(x, before, u, x_next, dt)``: x_next - f(x, (before + u) / 2), (n, 3) [m, m, rad]: u is reached at the end of
the step, from ``before`` at its beginning, as by a base of limited accelerations.""",
)

tracking = residual(
    StatedKernel(_deviation, (SE2, (3,)), 3, name="tracking"),
    takes=(POSE, POSE),
    about="""
``tracking(x, reference)``: deviation from a reference pose in world axes, (n, 3) [m, m, rad] (Bazzana eq. 8).""",
)

rate = residual(
    replace(BASE.rate.kernel, name="rate"),
    takes=(CONTROL, CONTROL),
    about="""``rate(u, u_next)``: change of control, (n, 2) [m/s, rad/s].""",
)
