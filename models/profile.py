"""Profiles of soft margins and potentials: scalar functions of a distance, row by row.

Of a distance that is a plain function, the profile is one, too, and derivatives are derived. Of one that is compiled
by hand, as those that look up a map, it is compiled: ``profile(d, numbers)`` returns g and g', and with
r = g(d) the Jacobian is g' times that of the distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import TypeAlias

import numpy as np

from unifg.codegen.calls import vector
from unifg.codegen.jit import compiled
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Residual, residual
from unifg.typing import Array

Profile: TypeAlias = Callable[[float, Array], tuple[float, float]]


def plain(distance: Residual, profile: Callable[[Array], Array], name: str) -> Residual | None:
    """``profile(distance(...))``, same shape, of a distance that is a plain function; None for others."""
    kernel = distance.kernel
    function = kernel.function if isinstance(kernel, StatedKernel) else distance.function
    if not isinstance(kernel, StatedKernel) and (kernel is not None or distance.jacobian or distance.rows):
        return None
    composed = partial(_composed, profile, function)
    if kernel is None:
        return residual(composed, name=name, takes=distance.takes)
    return residual(replace(kernel, function=composed, name=name, linear=False), takes=distance.takes)


def _composed(profile: Callable[[Array], Array], function: Callable[..., Array], *arguments: Array) -> Array:
    return profile(function(*arguments))


@cache
def first_order(distance: Callable[..., None], profile: Profile, count: int) -> Callable[..., None]:
    """Write g of a distance; ``count`` numbers of the profile stand in front of the table of the distance."""

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        distance(v, p, vector(table, count, len(table) - count), r, J)
        for a in range(len(r)):
            value, slope = profile(r[a], table)
            r[a] = value
            if len(J):
                for d in range(J.shape[1]):
                    J[a, d] *= slope

    return kernel


def _chained(slope: Callable[[Array], Array], distance: Residual, *arguments: Array) -> list[Array]:
    assert distance.jacobian is not None
    slopes = slope(np.asarray(distance.function(*arguments), dtype=np.float64))[:, :, None]
    return [slopes * block for block in distance.jacobian(*arguments)]


def of_distance(
    distance: Residual, profile: Profile, numbers: list[float], name: str, function: Callable[[Array], Array],
    slope: Callable[[Array], Array],
) -> Residual:  # fmt: skip
    """``g(distance(...))``, same shape.

    Args:
        distance: with a Jacobian, attached or derived [m].
        profile: g, compiled.
        numbers: that it reads.
        name: of the residual.
        function: g, plain.
        slope: g', plain.
    """
    made = plain(distance, function, name)
    if made is not None:
        return made
    first, kernel = np.array(numbers, dtype=np.float64), distance.kernel
    if kernel is None:
        values, slopes = partial(_composed, function, distance.function), partial(_chained, slope, distance)
        return residual(values, slopes, name, takes=distance.takes)
    table = np.concatenate([first, kernel.table])
    composed = first_order(kernel.function, profile, len(first))
    return residual(replace(kernel, function=composed, table=table, name=name, linear=False), takes=distance.takes)
