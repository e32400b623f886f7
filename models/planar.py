"""Bases that move in the plane: a pose on SE(2), controls, and the body velocities that they make.

A base is a function from controls (n, m) to body velocities: forward, sideways where it slides, and turning, the last.
Poses move along the heading at mid-step, as those of Bazzana et al. (2022, eq. 12-14). The bicycle has its pose at the
middle of the rear axle, where it does not slide: turning is v tan(delta) / wheelbase (Rajamani, *Vehicle Dynamics and
Control*, 2nd ed. 2012, section 2.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial

import numpy as np

from unifg.codegen.calls import call_residual, vector
from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.errors import ModelError, require_kinds
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE2, Rn, wrap_angle
from unifg.lie.so2 import wrap
from unifg.modeling.factors import difference
from unifg.typing import Array, ArrayLike, BoolArray

__all__ = ["Base", "ackermann"]

POSE = "m, m, rad in W_T_B"  # units and frame of a pose
BASES = ("unicycle", "ackermann", "omnidirectional")


@dataclass(frozen=True, eq=False)
class Base:
    """A base in the plane, with the residuals of its motion.

    Attributes:
        name: as an option gives it.
        size: m, number of controls; the last one turns.
        velocities: plain function of controls (n, m): body velocities (n, 2) forward and turning, or (n, 3) with
            sideways between [m/s, rad/s].
        turning_radius: least radius of a turn [m]; 0 for a base that turns on the spot.
        steering: greatest value [rad] and rate [rad/s] of the last control where it is a steering angle; None where it
            is the turning rate. A steering angle need not be zero at rest.
    """

    name: str
    size: int
    velocities: Callable[[Array], Array]
    turning_radius: float = 0.0
    steering: tuple[float, float] | None = None

    def __reduce__(self) -> tuple[Callable[[str], Base], tuple[str]]:
        """Pickle the name: one base, and one set of kernels, in a process."""
        return base_of, (self.name,)

    @property
    def slides(self) -> bool:
        """True if it moves sideways, too."""
        return self.size > 2

    @property
    def resting(self) -> BoolArray:
        """(m,) True for controls that are zero at rest."""
        return np.array([True] * (self.size - 1) + [self.steering is None])

    def spread(self, pair: tuple[float, float]) -> Array:
        """(m,) one number for translation and one for turning, for every control."""
        return np.array([pair[0]] * (self.size - 1) + [pair[1]])

    def of(self, control: Array) -> Array:
        """Body velocities (k,) of a control (m,)."""
        found: Array = self.velocities(control[None])[0]
        return found

    def turning(self, rate: float, speed: float) -> float:
        """Last control that turns at a rate [rad/s] at a speed [m/s], which is not zero where it is an angle."""
        if self.steering is None:
            return rate
        wheelbase = self.turning_radius * math.tan(self.steering[0])
        return float(np.clip(math.atan(wheelbase * rate / speed), -self.steering[0], self.steering[0]))

    @cached_property
    def moving(self) -> StatedKernel:
        """``moving(x, u, dt)``: by how much poses change in world axes, (n, 3) [m, m, rad]."""
        return StatedKernel(partial(_moves, self.velocities), (SE2, Rn(self.size), ()), 3, name=f"moves{self._suffix}")

    @cached_property
    def dynamics(self) -> Residual:
        """``dynamics(x, u, x_next, dt)``: x_next - f(x, u), (n, 3) [m, m, rad]."""
        kinds = SE2, Rn(self.size), SE2, ()
        return residual(
            StatedKernel(partial(_defect, self.velocities), kinds, 3, name=f"dynamics{self._suffix}"),
            takes=(POSE, "in B", POSE, "s"),
        )

    @cached_property
    def ramped(self) -> Residual:
        """``ramped(x, before, u, x_next, dt)``: the same of controls that change steadily from ``before`` to ``u``."""
        control = Rn(self.size)
        kinds, name = (SE2, control, control, SE2, ()), f"ramped dynamics{self._suffix}"
        kernel = StatedKernel(partial(_ramped_defect, self.velocities), kinds, 3, name=name)
        return residual(kernel, takes=(POSE, "in B", "in B", POSE, "s"))

    @cached_property
    def rate(self) -> Residual:
        """``rate(u, u_next)``: change of control, (n, m)."""
        return difference.on(Rn(self.size))

    @property
    def _suffix(self) -> str:
        return "" if self.name == BASES[0] else f" of {self.name}"

    def step(self, x: Array, u: Array, dt: ArrayLike) -> Array:
        """Advance by one sample with the heading at mid-step.

        Args:
            x: (n, 3) poses [m, m, rad], or one for all controls.
            u: (n, m) controls, or one for all poses.
            dt: sampling time [s], one or (n,).

        Returns:
            (n, 3) next poses.

        Raises:
            ModelError: on another shape.
        """
        x, u = np.atleast_2d(x), np.atleast_2d(u)
        moved = np.empty((max(len(x), len(u)), 3))
        self._advance(_rows(x, moved, 3), u, dt, moved)
        return moved

    def rollout(self, start: Array, u: Array, dt: ArrayLike) -> Array:
        """States reached from ``start`` (3,) under controls (n, m): (n + 1, 3); as :meth:`step` raises."""
        if np.size(start) != 3:
            raise ModelError(f"a rollout starts at a pose (3,), got {np.shape(start)}")
        states = np.empty((len(u) + 1, 3))
        states[0] = start
        self._advance(states[:-1], u, dt, states[1:])
        return states

    def followed(self, pose: Array, last: Array, controls: Array, dt: float) -> Array:
        """(N + 1, 3) poses from ``pose`` on under controls (N, m) that are reached at the ends of their steps."""
        return self.rollout(pose, ramp(last, controls), dt)

    def _advance(self, x: Array, u: ArrayLike, dt: ArrayLike, moved: Array) -> None:
        _advance_all(self.moving.address, x, _rows(u, moved, self.size), step_times(dt, len(moved)), moved)


def step_times(dt: ArrayLike, count: int) -> Array:
    """(count,) lengths of steps [s].

    Raises:
        ModelError: there are others than one or so many.
    """
    given = np.asarray(dt, dtype=np.float64)
    if given.shape not in ((), (1,), (count,)):
        raise ModelError(f"steps have one dt [s] for all or one for each of {count}; found shape {given.shape}")
    return np.array(np.broadcast_to(given, count), order="C")


def _same(u: Array) -> Array:
    return u


def _steered(wheelbase: float, u: Array) -> Array:
    turn: Array = u[:, 0] * np.tan(u[:, 1]) / wheelbase
    return np.stack([u[:, 0], turn], axis=1)


def _moves(velocities: Callable[[Array], Array], x: Array, u: Array, dt: Array) -> Array:
    """Change of the pose with the heading at mid-step (eq. 12-14)."""
    body = velocities(u)
    along, turn = dt * body[:, 0], dt * body[:, -1]
    middle = x[:, 2] + 0.5 * turn
    cosine, sine = np.cos(middle), np.sin(middle)
    if body.shape[1] == 2:
        return np.stack([along * cosine, along * sine, turn], axis=1)
    aside = dt * body[:, 1]
    return np.stack([along * cosine - aside * sine, along * sine + aside * cosine, turn], axis=1)


def _defect(velocities: Callable[[Array], Array], x: Array, u: Array, after: Array, dt: Array) -> Array:
    """x_next - f(x, u) in world axes (eq. 11), heading wrapped; poses differ before anything small is taken off."""
    moves = _moves(velocities, x, u, dt)
    turned = wrap_angle(after[:, 2:] - wrap_angle(x[:, 2:] + moves[:, 2:]))
    return np.concatenate([(after[:, :2] - x[:, :2]) - moves[:, :2], turned], axis=1)


def _ramped_defect(
    velocities: Callable[[Array], Array], x: Array, before: Array, u: Array, after: Array, dt: Array
) -> Array:
    return _defect(velocities, x, 0.5 * (before + u), after, dt)


@compiled
def _advance_all(where: int, x: Array, u: Array, dt: Array, out: Array) -> None:
    """Advance row by row, in order: ``out`` may be ``x`` one row further on; ``where`` is the code of ``moving``."""
    size = u.shape[1]
    v, moves, nothing = np.empty(3 + size), np.empty(3), np.empty((0, 0))
    for i in range(len(out)):
        copy_to(x[i], v[:3])
        copy_to(u[i], v[3:])
        call_residual(where, v, vector(dt, i, 1), moves, moves, nothing)
        out[i, 0], out[i, 1] = x[i, 0] + moves[0], x[i, 1] + moves[1]
        out[i, 2] = wrap(x[i, 2] + moves[2])


def ramp(last: Array, u: Array) -> Array:
    """Mean controls (n, m) of steps at whose ends the controls are u (n, m), from ``last`` (m,) on."""
    return 0.5 * (np.concatenate([last[None], u[:-1]]) + u)


def _rows(part: ArrayLike, moved: Array, size: int) -> Array:
    """One contiguous row per result."""
    array = np.asarray(part, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != size:
        raise ModelError(f"poses and controls of a base are (n, 3) and (n, m), here (n, {size}); got {array.shape}")
    if len(array) not in (1, len(moved)):
        raise ModelError(f"poses and controls of a base have as many rows, or one; got {len(array)} and {len(moved)}")
    return np.array(np.broadcast_to(array, (len(moved), size)), order="C")


def ackermann(wheelbase: float = 0.3, steering: float = 0.6, rate: float = 2.0) -> Base:
    """A bicycle with controls (v, delta) [m/s, rad] and its pose at the middle of the rear axle.

    Args:
        wheelbase: between the axles [m].
        steering: greatest steering angle [rad].
        rate: greatest change of it [rad/s].

    Raises:
        ModelError: a number that no car has.
    """
    require_kinds("a bicycle", ModelError, ackermann.__annotations__, locals())
    if not (0.0 < wheelbase < math.inf and 0.0 < steering < 0.5 * math.pi and rate > 0.0):
        raise ModelError(
            f"a bicycle needs a wheelbase above 0 m, a steering angle in (0, pi/2) and a rate above 0, got "
            f"{wheelbase:g} m, {steering:g} rad and {rate:g} rad/s"
        )
    name = f"ackermann:{wheelbase!r},{steering!r},{rate!r}"
    turned = partial(_steered, wheelbase)
    return Base(name, 2, turned, wheelbase / math.tan(steering), (steering, rate))


@cache
def base_of(name: str) -> Base:
    """A base by name: one of `BASES`, the second also as "ackermann:WHEELBASE,STEERING,RATE" [m, rad, rad/s].

    Raises:
        ModelError: for another name.
    """
    kind, _, numbers = name.partition(":")
    if kind == "ackermann":
        try:
            return ackermann(*(float(word) for word in numbers.split(",") if numbers))
        except (TypeError, ValueError) as error:
            raise ModelError(f"{name!r} is not ackermann:WHEELBASE,STEERING,RATE [m, rad, rad/s]") from error
    if name not in BASES:
        raise ModelError(f"unknown base {name!r}: choose {', '.join(BASES)}, or ackermann:WHEELBASE,STEERING,RATE")
    return Base(name, 2 if name == BASES[0] else 3, _same)
