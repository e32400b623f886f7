"""An arm of two links in a vertical plane (Murray, Li, Sastry, *Robotic Manipulation*, 1994, section 4.2, eq. 4.11).

The joints turn on SO(2): q_1 [rad] from the horizontal, q_2 from the first link; control: torques tau [Nm]. With s, c
for sine and cosine, alpha = I_1 + I_2 + m_1 r_1^2 + m_2 (l_1^2 + r_2^2), beta = m_2 l_1 r_2, delta = I_2 + m_2 r_2^2,

    (alpha + 2 beta c_2) q_1'' + (delta + beta c_2) q_2'' = tau_1 + beta s_2 (2 q_1' + q_2') q_2' - n_1 - n_2
    (delta + beta c_2) q_1'' + delta q_2''                = tau_2 - beta s_2 q_1'^2 - n_2

and the weight of the links n_1 = (m_1 r_1 + m_2 l_1) g c_1, n_2 = m_2 r_2 g c_12 (0 in a horizontal plane).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.factors.residuals import Residual
from unifg.lie import SO2, Product, Rn
from unifg.models import rkmk
from unifg.models.constants import require_constants
from unifg.models.rkmk import Field
from unifg.typing import Array

__all__ = ["STATE", "Arm", "dynamics", "field"]

STATE = Product(shoulder=SO2, elbow=SO2, rates=Rn(2))
"""Storage (q_1, q_2, q_1', q_2') [rad, rad, rad/s, rad/s]."""
TORQUES = Rn(2)


@dataclass(frozen=True)
class Arm:
    """Of both links: masses m [kg], lengths l [m], centres r [m] from the joint, inertias I [kg m^2]; g [m/s^2].

    Raises:
        ModelError: for a link without mass or length, a negative inertia, or what is not finite.
    """

    masses: tuple[float, float] = (1.0, 1.0)
    lengths: tuple[float, float] = (0.5, 0.5)
    centres: tuple[float, float] = (0.25, 0.25)
    inertias: tuple[float, float] = (1 / 48, 1 / 48)
    gravity: float = 9.81

    def __post_init__(self) -> None:
        """Refuse links that are none."""
        require_constants(self, ("masses", "lengths"), ("inertias",))


def field(arm: Arm) -> Field:
    """``field(arm)(x, tau)``: F, (n, 4), for states (n, 4) and torques (n, 2)."""
    (m1, m2), (l1, _), (r1, r2), (i1, i2), g = arm.masses, arm.lengths, arm.centres, arm.inertias, arm.gravity
    alpha, beta, delta = i1 + i2 + m1 * r1**2 + m2 * (l1**2 + r2**2), m2 * l1 * r2, i2 + m2 * r2**2

    def manipulator(x: Array, tau: Array) -> Array:
        q1, q2, w1, w2 = x[:, 0], x[:, 1], x[:, 2], x[:, 3]
        bend, n2 = beta * np.sin(q2), m2 * r2 * g * np.cos(q1 + q2)
        f1 = tau[:, 0] + bend * (2.0 * w1 + w2) * w2 - (m1 * r1 + m2 * l1) * g * np.cos(q1) - n2
        f2 = tau[:, 1] - bend * w1**2 - n2
        a, b = alpha + 2.0 * beta * np.cos(q2), delta + beta * np.cos(q2)
        determinant = a * delta - b * b
        return np.stack([w1, w2, (delta * f1 - b * f2) / determinant, (a * f2 - b * f1) / determinant], axis=1)

    return manipulator


def dynamics(arm: Arm, method: rkmk.Method = "hermite-simpson") -> Residual:
    """``dynamics(arm)(x, tau, x_next, h)``: defect of a step of h [s], (n, 4) [rad, rad, rad/s, rad/s]."""
    return rkmk.integrator(STATE, field(arm), method)
