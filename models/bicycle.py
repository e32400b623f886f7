"""A car without slip: the kinematic bicycle (Rajamani, *Vehicle Dynamics and Control*, 2nd ed. 2012, section 2.2).

Pose (px, py, psi) [m, m, rad] of the centre of gravity, l_f behind the front axle and l_r ahead of the rear one, and
speed v [m/s] along its path; control u = (a, delta): acceleration [m/s^2] and angle of the front wheels [rad]. The path
leaves the car's axis by the slip angle beta; with straight rear wheels, in world axes

    px' = v cos(psi + beta),  py' = v sin(psi + beta),  psi' = v sin(beta) / l_r,  v' = a,
    tan(beta) = l_r tan(delta) / (l_f + l_r)

which are (v cos(beta), v sin(beta), v sin(beta) / l_r) in the car's. Wheels roll without slip up to some 5 m/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.factors.residuals import Residual
from unifg.lie import SE2, Product, Rn
from unifg.models import rkmk
from unifg.models.constants import require_constants
from unifg.models.rkmk import Field
from unifg.typing import Array

__all__ = ["STATE", "Bicycle", "dynamics", "field"]

STATE = Product(pose=SE2, speed=Rn(1))
CONTROL = Rn(2)


@dataclass(frozen=True)
class Bicycle:
    """Positions of the axles: distances from the centre of gravity to the front and to the rear one [m].

    Raises:
        ModelError: unless the rear axle lies behind the centre of gravity, and the front axle not behind it.
    """

    front: float = 1.2
    rear: float = 1.4

    def __post_init__(self) -> None:
        """Refuse axles that no path divides by."""
        require_constants(self, ("rear",), ("front",))


def field(car: Bicycle) -> Field:
    """``field(car)(x, u)``: F, (n, 4), for states x = (px, py, psi, v) and controls u = (a, delta)."""
    share, rear = car.rear / (car.front + car.rear), car.rear

    def bicycle(x: Array, u: Array) -> Array:
        v, a, delta = x[:, 3], u[:, 0], u[:, 1]
        beta = np.arctan(share * np.tan(delta))
        return np.stack([v * np.cos(beta), v * np.sin(beta), v * np.sin(beta) / rear, a], axis=1)

    return bicycle


def dynamics(car: Bicycle, method: rkmk.Method = "hermite-simpson") -> Residual:
    """``dynamics(car)(x, u, x_next, h)``: defect of a step of h [s], (n, 4) [m, m, rad, m/s]."""
    return rkmk.integrator(STATE, field(car), method)
