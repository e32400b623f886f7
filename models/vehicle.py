"""Longitudinal motion of a road vehicle: speed v [m/s], drive or brake force f [N] (ecg2o, section 5.1, eq. 20-21).

    m_eq dv/dt = f - m g sin(a) - c_r m g cos(a) - (p1 + p2 v + c_a v^2)

with the slope a [rad] of the road, rolling resistance c_r, and air drag c_a v^2 or its linear stand-in p1 + p2 v. The
equivalent mass m_eq is larger than m by what turns with the wheels. Drag and rolling resistance oppose forward motion;
the model means nothing for v < 0. Time is discretised by one step of Euler's method, as in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import Rn
from unifg.models.constants import require_constants
from unifg.typing import Array, ArrayLike

__all__ = ["Vehicle", "dynamics"]

SPEED = Rn(1)
FORCE = Rn(1)


@dataclass(frozen=True)
class Vehicle:
    """Parameters of a vehicle; the defaults are those of the paper's study (its published code).

    Attributes:
        equivalent_mass: m_eq, mass with the inertia of what rotates [kg].
        mass: m [kg].
        rolling: c_r, coefficient of rolling resistance.
        drag: c_a, air drag [N s^2/m^2].
        drag_constant: p1 [N].
        drag_linear: p2 [N s/m].
        gravity: g [m/s^2].
    """

    equivalent_mass: float = 1639.0408163265306
    mass: float = 1537.0
    rolling: float = 0.00708572690577572
    drag: float = 0.421022
    drag_constant: float = 0.0
    drag_linear: float = 0.0
    gravity: float = 9.81

    def __post_init__(self) -> None:
        """Refuse what cannot drive.

        Raises:
            ModelError: a number is not finite; a mass is not positive.
        """
        require_constants(self, ("equivalent_mass", "mass"))

    def linearised(self, constant: float = 0.0, linear: float = 20.0) -> Vehicle:
        """The same vehicle with drag p1 + p2 v in place of c_a v^2 [N], [N s/m]."""
        return replace(self, drag=0.0, drag_constant=constant, drag_linear=linear)

    def resistance(self, v: ArrayLike, slope: ArrayLike = 0.0) -> Array:
        """Force that opposes forward motion at speed v [m/s] on a slope [rad], [N]."""
        v, slope = np.asarray(v, dtype=np.float64), np.asarray(slope, dtype=np.float64)
        road = self.mass * self.gravity * (np.sin(slope) + self.rolling * np.cos(slope))
        return np.asarray(road + self.drag_constant + self.drag_linear * v + self.drag * v**2)

    def rollout(self, start: float, f: Array, dt: float, slope: ArrayLike = 0.0) -> Array:
        """(n + 1,) speeds from ``start`` [m/s] under forces (n,) [N]."""
        slopes = np.broadcast_to(np.asarray(slope, dtype=np.float64), (len(f),))
        v = np.empty(len(f) + 1)
        v[0] = start
        for k in range(len(f)):
            v[k + 1] = v[k] + dt / self.equivalent_mass * (f[k] - float(self.resistance(v[k], slopes[k])))
        return v


def _defect(car: Vehicle, v: Array, force: Array, after: Array, dt: Array, slope: Array) -> Array:
    """v_next - v - dt / m_eq (f - resistance)."""
    road = car.mass * car.gravity * (np.sin(slope) + car.rolling * np.cos(slope))
    resistance = road + car.drag_constant + (car.drag_linear + car.drag * v[:, 0]) * v[:, 0]
    defect: Array = after[:, 0] - v[:, 0] - dt / car.equivalent_mass * (force[:, 0] - resistance)
    return defect[:, None]


def dynamics(vehicle: Vehicle) -> Residual:
    """The residual ``f(v, force, v_next, dt, slope)``: v_next minus the speed predicted, (n, 1) [m/s]."""
    arguments = SPEED, FORCE, SPEED, (), ()
    takes = "m/s", "N", "m/s", "s", "rad"
    return residual(StatedKernel(partial(_defect, vehicle), arguments, 1, name="vehicle.dynamics"), takes=takes)
