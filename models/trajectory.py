"""Trajectories in continuous time: cumulative cubic B-splines on any Lie group, of which four poses hold each moment.

With control poses c_0, c_1, ... and the moments between two knots at u in [0, 1] of the spacing h,

    x(u) = c_k Exp(B_1(u) d_1) Exp(B_2(u) d_2) Exp(B_3(u) d_3),    d_j = Log(c_{k+j-1}^-1 c_{k+j}),

B_1 = (5 + 3u - 3u^2 + u^3) / 6, B_2 = (1 + 3u + 3u^2 - 2u^3) / 6, B_3 = u^3 / 6 (Kim, Kim, Shin 1995, *A general
construction scheme for unit quaternion curves*; Lovegrove, Patron-Perez, Sibley 2013, *Spline fusion*). Pose, velocity
and acceleration are continuous, and turning or moving the world turns and moves the trajectory. Velocity and
acceleration in the axes of the body follow from left to right (Sommer et al. 2020, *Efficient derivative computation
for cumulative B-splines on Lie groups*), with A_j = Exp(B_j d_j),

    w <- Ad(A_j^-1) w + B_j' d_j,    a <- Ad(A_j^-1) a + B_j' [w, d_j] + B_j'' d_j    (w the new one).

Control poses are guides, not places the trajectory passes through: at the knot of c_k it is at their mean with weights
1/6, 4/6, 1/6. The functions are batched NumPy and are traced, so a measurement at any moment is a factor on four
members, with exact derivatives::

    curve = CubicTrajectory(fg.SE3, start=0.0, spacing=0.1)
    seen = lambda a, b, c, d, u, z: fg.SE3.local(z, curve.pose(a, b, c, d, u))
    graph.minimize(seen, *curve.places(stamps, len(x)).of(x), measured, sigma=0.01)
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import cache
from math import isfinite
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np

from unifg.errors import ModelError, require_kinds, require_positive
from unifg.lie import LieGroup
from unifg.modeling.duplicates import doubles
from unifg.modeling.variables import Family
from unifg.typing import Array, ArrayLike, IntArray

__all__ = ["CubicTrajectory"]

Function: TypeAlias = Callable[[Array, Array, Array, Array, Array], Array]
ORDER = 4  # control poses that hold a moment


class Places(NamedTuple):
    """Segments of a trajectory and positions within them.

    Attributes:
        first: (n,) first of the four control poses.
        fraction: (n,) u, from 0 to 1.
    """

    first: IntArray
    fraction: Array

    def of(self, controls: Family) -> tuple[Any, ...]:
        """The four members for each moment, and its fraction: what comes first among the arguments of a factor."""
        return (*(controls[self.first + j] for j in range(ORDER)), self.fraction)


@dataclass(frozen=True)
class CubicTrajectory:
    """A cumulative cubic B-spline.

    Its three functions take four control poses a, b, c, d, each (n, storage), and the fractions u (n,); residuals may
    call them.

    Attributes:
        group: of the poses.
        start: of the first moment [s].
        spacing: between two knots [s].
        pose: ``pose(a, b, c, d, u)``, (n, storage).
        velocity: likewise, (n, dim) in the axes of the body [units of the tangent per s].
        acceleration: likewise, (n, dim) derivatives of the velocity; a point of the body at rest in it accelerates by
            the linear part of SE(3) plus omega x v, in the axes of the body.

    Raises:
        ModelError: a start or spacing that is not finite, or a spacing that is not positive.
    """

    group: LieGroup
    start: float = 0.0
    spacing: float = 1.0
    pose: Function = field(init=False, repr=False, compare=False)
    velocity: Function = field(init=False, repr=False, compare=False)
    acceleration: Function = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Look at the knots."""
        require_kinds("trajectory", ModelError, CubicTrajectory.__annotations__, vars(self), LieGroup)
        require_positive("trajectory", ModelError, spacing=self.spacing)
        if not isfinite(self.start):
            raise ModelError(f"trajectory: start {self.start!r} must be finite")
        functions = _functions(cast(Hashable, self.group), float(self.spacing))
        for name, function in zip(("pose", "velocity", "acceleration"), functions, strict=True):
            object.__setattr__(self, name, function)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what was stated; the functions are made again."""
        return CubicTrajectory, (self.group, self.start, self.spacing)

    def controls(self, end: float) -> int:
        """Number of control poses that hold all moments up to an end [s].

        Raises:
            ModelError: the end is not finite.
        """
        require_kinds("trajectory", ModelError, CubicTrajectory.controls.__annotations__, {"end": end})
        if not isfinite(end):
            raise ModelError(f"trajectory: the end {end!r} must be finite")
        return ORDER + max(int(np.ceil((end - self.start) / self.spacing - self._slack(end))) - 1, 0)

    def knots(self, count: int) -> Array:
        """(count,) moments that the control poses belong to [s]; the first and the last lie outside.

        Poses known at about these moments are a guess of the control poses.
        """
        return self.start + self.spacing * (np.arange(count, dtype=np.float64) - 1.0)

    def places(self, times: ArrayLike, count: int) -> Places:
        """Segments of (n,) moments [s] among this many control poses.

        Raises:
            ModelError: naming a moment before the start, after the end or not finite; too few control poses; or moments
                in a column or a table.
        """
        times = np.atleast_1d(doubles("trajectory: moments", times, error=ModelError))
        if times.ndim > 1:
            raise ModelError(f"trajectory: moments are (n,), found {times.shape}: np.ravel(moments)")
        if count < ORDER:
            raise ModelError(f"trajectory: {count} control poses hold no moment, {ORDER} the first interval")
        since = (times - self.start) / self.spacing
        last = count - ORDER
        slack = self._slack(times)
        outside = ~((since >= -slack) & (since <= last + 1 + slack))
        if outside.any():
            index = int(np.argmax(outside))
            raise ModelError(
                f"trajectory: moment {times[index]:.12g} s (number {index}) is outside of {self.start:.12g} .. "
                f"{self.start + (last + 1) * self.spacing:.12g} s, which {count} control poses hold"
            )
        first = np.clip(np.floor(since), 0, last).astype(np.int64)
        return Places(first, np.clip(since - first, 0.0, 1.0))

    def _slack(self, times: Any) -> Any:
        """Spacings by which rounding may put moments outside: those since 1970 have steps of 0.2 us."""
        return 1e-9 + 2.0 * np.spacing(np.maximum(np.abs(times), abs(self.start))) / self.spacing

    def at(self, controls: ArrayLike, times: ArrayLike) -> Array:
        """(n, storage) poses at (n,) moments [s], of (N, storage) control poses; as :meth:`places` raises."""
        return self.pose(*self._held(controls, times))

    def velocity_at(self, controls: ArrayLike, times: ArrayLike) -> Array:
        """(n, dim) velocities in the axes of the body, likewise."""
        return self.velocity(*self._held(controls, times))

    def acceleration_at(self, controls: ArrayLike, times: ArrayLike) -> Array:
        """(n, dim) their derivatives, likewise."""
        return self.acceleration(*self._held(controls, times))

    def _held(self, controls: ArrayLike, times: ArrayLike) -> tuple[Array, Array, Array, Array, Array]:
        array = doubles("trajectory: control poses", controls, error=ModelError)
        if array.ndim != 2 or array.shape[1] != self.group.storage:
            raise ModelError(f"trajectory: control poses are (N, {self.group.storage}), found {array.shape}")
        first, fraction = self.places(times, len(array))
        return array[first], array[first + 1], array[first + 2], array[first + 3], fraction


@cache
def _functions(hashable: Hashable, spacing: float) -> tuple[Function, Function, Function]:
    """Of four control poses: pose, velocity, acceleration."""
    group = cast(LieGroup, hashable)
    bracket = np.swapaxes(group.ad(np.eye(group.dim)), 1, 2)  # [e_i, e_j] = sum_k c_ijk e_k

    def pose(a: Array, b: Array, c: Array, d: Array, u: Array) -> Array:
        at = a
        for weight, step in zip(_weights(u)[0], (group.local(a, b), group.local(b, c), group.local(c, d)), strict=True):
            at = group.compose(at, group.exp(weight * step))
        return at

    def rates(a: Array, b: Array, c: Array, d: Array, u: Array, accelerate: bool) -> Array:
        one, two, three = group.local(a, b), group.local(b, c), group.local(c, d)
        (_, x, y), (v1, v2, v3), (w1, w2, w3) = _weights(u)
        rate, change = (v1 / spacing) * one, (w1 / spacing**2) * one
        for weight, faster, later, step in ((x, v2, w2, two), (y, v3, w3, three)):
            back, faster = group.adjoint(group.exp(-weight * step)), (faster / spacing) * step
            rate = np.einsum("nij,nj->ni", back, rate) + faster
            if accelerate:
                change = np.einsum("nij,nj->ni", back, change) + (later / spacing**2) * step
                change = change + np.einsum("ijk,ni,nj->nk", bracket, rate, faster)
        return change if accelerate else rate

    def velocity(a: Array, b: Array, c: Array, d: Array, u: Array) -> Array:
        return rates(a, b, c, d, u, False)

    def acceleration(a: Array, b: Array, c: Array, d: Array, u: Array) -> Array:
        return rates(a, b, c, d, u, True)

    return pose, velocity, acceleration


def _weights(u: Array) -> tuple[tuple[Array, ...], tuple[Array, ...], tuple[Array, ...]]:
    """(n, 1) cumulative weights of the three steps, and their first two derivatives by u."""
    u = np.reshape(u, (-1, 1))
    value = (5.0 + u * (3.0 + u * (u - 3.0))) / 6.0, (1.0 + u * (3.0 + u * (3.0 - 2.0 * u))) / 6.0, u * u * u / 6.0
    first = 0.5 * (1.0 - u) * (1.0 - u), 0.5 + u * (1.0 - u), 0.5 * u * u
    return value, first, (u - 1.0, 1.0 - 2.0 * u, u)
