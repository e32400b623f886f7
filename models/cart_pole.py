"""A pole on a cart (Kelly, *An introduction to trajectory optimization*, SIAM Review 2017, section 6, eq. 6.1 and 6.2).

The cart stands at q [m] and is pushed by a force f [N]; the pole, a mass m_p at the end of a rod of length l without
mass, hangs at theta = 0 and turns towards +q [rad]:

    q''     = (l m_p sin(theta) theta'^2 + f + m_p g cos(theta) sin(theta)) / (m_c + m_p sin(theta)^2)
    theta'' = -(l m_p cos(theta) sin(theta) theta'^2 + f cos(theta) + (m_c + m_p) g sin(theta))
              / (l (m_c + m_p sin(theta)^2))
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

__all__ = ["STATE", "CartPole", "dynamics", "field"]

STATE = Product(cart=Rn(1), pole=SO2, rates=Rn(2))
"""Storage (q, theta, q', theta') [m, rad, m/s, rad/s]."""
FORCE = Rn(1)


@dataclass(frozen=True)
class CartPole:
    """Masses of cart and pole [kg], length of the rod [m], gravity [m/s^2]; defaults as in the paper.

    Raises:
        ModelError: for a cart without mass, a rod without length, a negative mass, or what is not finite.
    """

    cart: float = 1.0
    pole: float = 0.3
    length: float = 0.5
    gravity: float = 9.81

    def __post_init__(self) -> None:
        """Refuse what nothing can push."""
        require_constants(self, ("cart", "length"), ("pole",))


def field(robot: CartPole) -> Field:
    """``field(robot)(x, f)``: F, (n, 4), for states (n, 4) and forces (n, 1)."""
    m, l, g, total = robot.pole, robot.length, robot.gravity, robot.cart + robot.pole  # noqa: E741

    def cart_pole(x: Array, f: Array) -> Array:
        sine, cosine, speed, rate = np.sin(x[:, 1]), np.cos(x[:, 1]), x[:, 2], x[:, 3]
        push = f[:, 0] + m * l * sine * rate**2
        inertia = total - m * cosine**2
        along = (push + m * g * cosine * sine) / inertia
        return np.stack([speed, rate, along, -(push * cosine + total * g * sine) / (l * inertia)], axis=1)

    return cart_pole


def dynamics(robot: CartPole, method: rkmk.Method = "hermite-simpson") -> Residual:
    """``dynamics(robot)(x, f, x_next, h)``: defect of a step of h [s], (n, 4) [m, rad, m/s, rad/s]."""
    return rkmk.integrator(STATE, field(robot), method)
