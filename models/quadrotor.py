"""A quadrotor: its state, its parameters and its dynamics (Ta et al. 2014, section V).

State x = {p, R, v}: position [m] and velocity [m/s] in the world, z up, and attitude R = world_R_body. Control
u = (omega, T): body rates [rad/s], which a fast inner loop holds, and thrust [N] along the third axis of the body.
With process noise w = (w_omega, w_a) and static parameters rho = (mass, drag, wind, updraft), in the Lie algebra of
the product group R3 x SO(3) x R3,

    F(x, u, w, rho) = [ v,  omega + w_omega,  (T/m) R e3 - g e3 - R diag(drag) R' v / m + (wind, updraft) + w_a ]

The dynamics of a graph are the implicit trapezoid on that group (Ta III-B). The rate is held over a step, so that
the logarithm of the turn is parallel to it, dexp_inv leaves it alone, and the full and the simplified trapezoid have
the same solutions; the rows are those of the simplified one,

    p+ - p - h/2 (v + v+),    Log(R^-1 R+) - h (omega + w_omega),    v+ - v - h/2 (a(x) + a(x+))

with the acceleration a, the last three numbers of F. The attitude they lead to, R Exp(h omega), is exact.

Log(Exp(-h omega) R' R+) would vanish in the same places. Ta's row is linear in the rate, and its second derivatives are
exact wherever it is evaluated and not only where it vanishes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unifg.errors import ModelError
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import residual
from unifg.lie import SO3, Product, Rn
from unifg.models import quadrotor_dynamics
from unifg.models.planar import step_times
from unifg.models.quadrotor_dynamics import GRAVITY
from unifg.models.rkmk import alike, require_substeps
from unifg.typing import Array, ArrayLike

__all__ = [
    "CONTROL",
    "DRAG",
    "GRAVITY",
    "MASS",
    "STATE",
    "WIND",
    "Parameters",
    "disturbed_dynamics",
    "dynamics",
    "field",
    "fly",
    "hover",
    "hover_attitude",
    "rollout",
]

STATE = Product(p=Rn(3), R=SO3, v=Rn(3))
"""Storage (p, quaternion wxyz, v), 10 numbers; tangent (p, rotation vector, v), 9."""

P, R, V = (STATE.component(name).storage for name in ("p", "R", "v"))

CONTROL = Rn(4)
"""Body rates [rad/s], 3, and thrust [N]."""

NOISE = Rn(6)
"""Noise of the rates [rad/s], 3, and acceleration in the world [m/s^2], 3."""

MASS = Rn(1)
"""Mass [kg]. Mass and thrust gain are one parameter: T/m is all that either does."""

DRAG = Rn(3)
"""Drag along the axes of the body, D >= 0 [kg/s]."""

WIND = Rn(2)
"""What the wind adds to the horizontal acceleration [m/s^2]."""

UPDRAFT = Rn(1)
"""What the wind adds to the vertical acceleration [m/s^2]. At hover it cannot be told from the mass: fix one."""

UP = np.array([0.0, 0.0, 1.0])
"""The vertical, and the axis of the thrust in the body."""


@dataclass(frozen=True)
class Parameters:
    """Constants of a flight.

    Attributes:
        mass: [kg].
        drag: along the axes of the body [kg/s].
        wind: horizontal acceleration in the world [m/s^2].
        updraft: vertical acceleration [m/s^2].

    Raises:
        ModelError: on a mass that is not positive, a negative drag, a wrong length, or what is not finite.
    """

    mass: float = 1.0
    drag: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wind: tuple[float, float] = (0.0, 0.0)
    updraft: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what cannot fly."""
        try:
            drag, wind = tuple(float(d) for d in self.drag), tuple(float(a) for a in self.wind)
            mass, updraft = float(self.mass), float(self.updraft)
        except (TypeError, ValueError) as error:
            raise ModelError(f"a quadrotor's parameters are numbers, of drag 3, of wind 2: {error}") from error
        if len(drag) != 3 or len(wind) != 2:
            raise ModelError(
                f"a quadrotor has 3 drag coefficients and 2 of the wind, found {len(drag)} and {len(wind)}"
            )
        object.__setattr__(self, "mass", mass)
        object.__setattr__(self, "drag", drag)
        object.__setattr__(self, "wind", wind)
        object.__setattr__(self, "updraft", updraft)
        if not np.isfinite(self.packed).all():
            raise ModelError(f"a quadrotor's parameters must be finite, found {self}")
        if self.mass <= 0.0:
            raise ModelError(f"a quadrotor's mass must be positive, found {self.mass:g} kg")
        if min(drag) < 0.0:
            raise ModelError(f"a quadrotor's drag must not be negative, found {drag} kg/s")

    @property
    def packed(self) -> Array:
        """(7,) mass, drag, wind, updraft: what :data:`dynamics` takes."""
        return np.array([self.mass, *self.drag, *self.wind, self.updraft])

    @classmethod
    def unpacked(cls, packed: ArrayLike) -> Parameters:
        """From (7,) numbers in the order of :attr:`packed`.

        Raises:
            ModelError: on another shape, or on numbers the constructor refuses.
        """
        numbers = np.asarray(packed, dtype=np.float64)
        if numbers.shape != (7,):
            raise ModelError(f"a quadrotor has 7 parameters, found shape {numbers.shape}")
        mass, *rest = numbers.tolist()
        return cls(mass, (rest[0], rest[1], rest[2]), (rest[3], rest[4]), rest[5])


def pushed(x: Array, thrust: Array, mass: Array, drag: Array) -> Array:
    """(n, 3) acceleration by the rotors, whose thrust is (n, 1), and the air [m/s^2]."""
    return SO3.act(x[:, R], thrust * UP - drag * SO3.act(SO3.inverse(x[:, R]), x[:, V])) / mass


def field(x: Array, u: Array, w: Array, mass: Array, drag: Array, wind: Array, updraft: Array) -> Array:
    """F, (n, 9), for :func:`unifg.models.rkmk.integrator` on :data:`STATE`; an argument with one row is shared by all.

    The trapezoid made of it has the defect of :data:`disturbed_dynamics`; the other integrators are there to compare.
    """
    x, u, w, mass, drag, wind, updraft = alike(x, u, w, mass, drag, wind, updraft)
    acceleration = pushed(x, u[:, 3:], mass, drag) - GRAVITY * UP + np.concatenate([wind, updraft], axis=1) + w[:, 3:]
    return np.concatenate([x[:, 7:], u[:, :3] + w[:, :3], acceleration], axis=1)


def step(x: ArrayLike, u: ArrayLike, dt: ArrayLike, parameters: Parameters) -> Array:
    """Solve one step of :data:`dynamics`, without noise.

    Args:
        x: states, (n, 10) or one (1, 10).
        u: controls, (n, 4) or one (1, 4).
        dt: length of the step [s], one or (n,).
        parameters: of the vehicle.

    Returns:
        (n, 10) next states.

    Raises:
        ModelError: on another shape.
    """
    x, u = _rows(x, 10, "states"), _rows(u, 4, "controls")
    moved = np.empty((max(len(x), len(u)), 10))
    times = step_times(dt, len(moved))
    quadrotor_dynamics.advance_all(_spread(x, moved), _spread(u, moved), times, parameters.packed, moved)
    return moved


def rollout(start: ArrayLike, u: ArrayLike, dt: ArrayLike, parameters: Parameters) -> Array:
    """States reached from ``start`` (10,) under controls (n, 4), step after step: (n + 1, 10).

    Raises:
        ModelError: on another shape.
    """
    start, u = _single(start, 10, "state"), _rows(u, 4, "controls")
    states = np.empty((len(u) + 1, 10))
    states[0] = start
    rest = states[1:]
    times = step_times(dt, len(rest))
    quadrotor_dynamics.advance_all(states[:-1], _spread(u, rest), times, parameters.packed, rest)
    return states


def fly(
    state: ArrayLike,
    u: ArrayLike,
    dt: float,
    parameters: Parameters,
    noise: ArrayLike | None = None,
    substeps: int = 10,
) -> Array:
    """Integrate with RK-MK4 what :func:`step` approximates: where the vehicle is after ``dt`` seconds.

    The rate is held, so that all stages of the attitude are parallel and R Exp(t omega) is exact; what is left is
    the classical Runge-Kutta method of order four for position and velocity.

    Args:
        state: (10,).
        u: (4,) held control.
        dt: [s].
        parameters: of the vehicle.
        noise: (6,) held noise of the rates [rad/s] and accelerations [m/s^2]; None for none.
        substeps: equal steps that ``dt`` is cut into.

    Returns:
        (10,) state.

    Raises:
        ModelError: on another shape, or no whole number of substeps.
    """
    state, u = _single(state, 10, "state"), _single(u, 4, "control")
    disturbance = np.zeros(6) if noise is None else _single(noise, 6, "noise")
    require_substeps("fly", substeps)
    reached = state.copy()
    quadrotor_dynamics.integrate(reached, u, disturbance, parameters.packed, float(dt) / substeps, substeps)
    return reached


def hover(parameters: Parameters) -> Array:
    """(4,) control that keeps the vehicle in place at :func:`hover_attitude`: no rate, T = m |g e3 - wind|."""
    return np.array([0.0, 0.0, 0.0, parameters.mass * math.hypot(*_lift(parameters))])


def hover_attitude(parameters: Parameters) -> Array:
    """(4,) quaternion that leans into the wind by the shortest turn from level; level without wind.

    Raises:
        ModelError: when the updraft carries the vehicle, so that no thrust T > 0 at all holds it.
    """
    x, y, z = _lift(parameters)
    length = math.hypot(x, y, z)
    if z <= 0.0:
        raise ModelError(f"an updraft of {parameters.updraft:g} m/s^2 carries the vehicle: it cannot hover")
    return SO3.from_quaternion(np.array([length + z, -y, x, 0.0]) / math.hypot(length + z, x, y), order="wxyz")


def _lift(parameters: Parameters) -> tuple[float, float, float]:
    """Acceleration that the thrust has to give at hover."""
    return -parameters.wind[0], -parameters.wind[1], GRAVITY - parameters.updraft


def _single(given: ArrayLike, size: int, what: str) -> Array:
    """One row, contiguous."""
    array = np.ascontiguousarray(given, dtype=np.float64)
    if array.shape != (size,):
        raise ModelError(f"a quadrotor's {what} has shape ({size},), found {array.shape}")
    return array


def _rows(given: ArrayLike, size: int, what: str) -> Array:
    array = np.asarray(given, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != size:
        raise ModelError(f"a quadrotor's {what} have shape (n, {size}), found {array.shape}")
    return array


def _spread(part: Array, moved: Array) -> Array:
    """One contiguous row per result."""
    if len(part) not in (1, len(moved)):
        raise ModelError(f"a quadrotor's states and controls are as many, or one; found {len(part)} and {len(moved)}")
    return np.array(np.broadcast_to(part, (len(moved), part.shape[1])), order="C")


def _defect(
    x: Array, rates: Array, thrust: Array, blow: Array, mass: Array, drag: Array, x_next: Array, dt: Array
) -> Array:
    """(n, 9) rows of the trapezoid, given what the air adds to the acceleration (n, 3)."""
    h = np.reshape(dt, (-1, 1))
    push = 0.5 * (pushed(x, thrust, mass, drag) + pushed(x_next, thrust, mass, drag))
    moved = x_next[:, P] - x[:, P] - 0.5 * h * (x[:, V] + x_next[:, V])
    turned = SO3.log(SO3.compose(SO3.inverse(x[:, R]), x_next[:, R])) - h * rates
    return np.concatenate([moved, turned, x_next[:, V] - x[:, V] - h * (push - GRAVITY * UP + blow)], axis=1)


def _calm(x: Array, u: Array, x_next: Array, rho: Array, dt: Array) -> Array:
    return _defect(x, u[:, :3], u[:, 3:], rho[:, 4:], rho[:, :1], rho[:, 1:4], x_next, dt)


def _disturbed(
    x: Array, u: Array, w: Array, mass: Array, drag: Array, wind: Array, updraft: Array, x_next: Array, dt: Array
) -> Array:
    blow = np.concatenate([wind, updraft], axis=1) + w[:, 3:]
    return _defect(x, u[:, :3] + w[:, :3], u[:, 3:], blow, mass, drag, x_next, dt)


TAKES = "m, m, m, wxyz, m/s, m/s, m/s in W_T_B"
"""Units and frame of :data:`STATE`; W of its positions and velocities."""

_RATES = "rad/s, rad/s, rad/s"
_RHO = "kg, kg/s, kg/s, kg/s, m/s^2, m/s^2, m/s^2"
dynamics = residual(
    StatedKernel(_calm, (STATE, CONTROL, STATE, (7,), ()), 9, name="quadrotor dynamics"),
    takes=(TAKES, f"{_RATES}, N in B", TAKES, _RHO, "s"),
    about="""
``dynamics(x, u, x_next, parameters, dt)``: defects of position [m], attitude [rad] and velocity [m/s], (n, 9).

parameters: (7,) or (n, 7), as :attr:`Parameters.packed` gives them; constants or data. No noise.
""",
)

disturbed_dynamics = residual(
    StatedKernel(
        _disturbed,
        (STATE, CONTROL, NOISE, MASS, DRAG, WIND, UPDRAFT, STATE, ()),
        9,
        name="disturbed quadrotor dynamics",
    ),
    takes=(
        TAKES,
        f"{_RATES}, N in B",
        f"{_RATES}, m/s^2, m/s^2, m/s^2",
        "kg",
        "kg/s in B",
        "m/s^2 in W",
        "m/s^2 in W",
        TAKES,
        "s",
    ),
    about="""``disturbed_dynamics(x, u, w, mass, drag, wind, updraft, x_next, dt)``: the same defects, (n, 9).

Every argument but dt may be a family, a selection or a constant. The Jacobian has a pole at mass zero: bound a mass
that is estimated.
""",
)
