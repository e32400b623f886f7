"""Profiles of soft margins and potentials: scalar functions of a distance, row by row.

With r = g(d) the Jacobian is g' times that of the distance, and the Hessian of w' r is that of the distance under the
weights w g', and g'' times its gradients. A profile is compiled: ``profile(d, numbers)`` returns g, g' and g''.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TypeAlias

import numpy as np

from unifg.codegen.calls import vector
from unifg.codegen.jit import compiled
from unifg.factors.residuals import Residual, residual
from unifg.typing import Array

Profile: TypeAlias = Callable[[float, Array], tuple[float, float, float]]


@cache
def first_order(distance: Callable[..., None], profile: Profile, count: int) -> Callable[..., None]:
    """Write g of a distance; ``count`` numbers of the profile stand in front of the table of the distance."""

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        distance(v, p, vector(table, count, len(table) - count), r, J)
        for a in range(len(r)):
            value, slope, _ = profile(r[a], table)
            r[a] = value
            if len(J):
                for d in range(J.shape[1]):
                    J[a, d] *= slope

    return kernel


@cache
def _second_order(
    distance: Callable[..., None], second: Callable[..., None], profile: Profile, count: int
) -> Callable[..., None]:
    """Write the Hessian of w' g."""

    @compiled
    def kernel(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
        rows, width = len(w), len(S)
        rest = vector(table, count, len(table) - count)
        reached, slopes, gradient = np.empty(rows), np.empty(rows), np.empty((rows, width))
        distance(v, p, rest, reached, gradient)
        for a in range(rows):
            _, slope, _ = profile(reached[a], table)
            slopes[a] = w[a] * slope
        second(v, p, rest, slopes, S)
        for a in range(rows):
            _, _, curvature = profile(reached[a], table)
            for i in range(width):
                pull = w[a] * curvature * gradient[a, i]
                if pull != 0.0:
                    for k in range(width):
                        S[i, k] += pull * gradient[a, k]

    return kernel


@cache
def _loop(profile: Profile) -> Callable[..., None]:
    @compiled
    def loop(distance: Array, numbers: Array, value: Array, slope: Array) -> None:
        for i in range(len(distance)):
            value[i], slope[i], _ = profile(distance[i], numbers)

    return loop


class _Batched:
    """The same for a distance without a kernel."""

    def __init__(self, distance: Residual, profile: Profile, numbers: Array) -> None:
        self.distance, self.profile, self.numbers = distance, profile, numbers

    def both(self, *arguments: Array) -> tuple[Array, Array]:
        """Values and slopes, (n, m)."""
        distance = np.ascontiguousarray(self.distance.function(*arguments), dtype=np.float64)
        value, slope = np.empty(distance.size), np.empty(distance.size)
        _loop(self.profile)(distance.ravel(), self.numbers, value, slope)
        return value.reshape(distance.shape), slope.reshape(distance.shape)

    def __call__(self, *arguments: Array) -> Array:
        return self.both(*arguments)[0]

    def jacobian(self, *arguments: Array) -> list[Array]:
        assert self.distance.jacobian is not None
        slope = self.both(*arguments)[1]
        return [slope[:, :, None] * block for block in self.distance.jacobian(*arguments)]


def of_distance(distance: Residual, profile: Profile, numbers: list[float], name: str, twice: bool = False) -> Residual:
    """``g(distance(...))``, same shape.

    Args:
        distance: with a Jacobian attached [m].
        profile: g.
        numbers: that it reads.
        name: of the residual.
        twice: whether g is twice differentiable; the distance then has to be compiled, with a second derivative.
    """
    first, kernel = np.array(numbers, dtype=np.float64), distance.kernel
    if kernel is None:
        function = _Batched(distance, profile, first)
        return residual(function, function.jacobian, name)
    second = None
    if twice:
        assert kernel.second is not None
        second = _second_order(kernel.function, kernel.second, profile, len(first))
    made = first_order(kernel.function, profile, len(first))
    table = np.concatenate([first, kernel.table])
    return residual(replace(kernel, function=made, table=table, name=name, linear=False, second=second))
