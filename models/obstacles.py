"""Clearance from discs and from the walls of a map, as hard constraints and as soft margins."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from unifg.codegen.jit import compiled
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE2
from unifg.models.avoidance import count, to_balls
from unifg.models.distance_map import SmoothField, smooth
from unifg.models.profile import of_distance
from unifg.typing import Array

__all__ = ["disc_clearance", "shortfall", "wall_distance"]

disc_clearance = residual(
    StatedKernel(to_balls, (SE2, 2, 1), partial(count, "disc clearance", 2, "pose"), name="disc clearance"),
    about="""``disc_clearance(x, centre, radius)``: |p - c| - r [m], one column per disc, (n, M).

x: (n, 3) SE(2) poses. centre: (M, 2) shared by all poses or (n, M, 2), one set for each, as for moving discs.
radius: (M,) or (n, M); give the sum of the disc's and the robot's radii for hull clearance.
""",
)


@compiled
def _wall_distance(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Smoothed distance of a position to the nearest wall."""
    r[0], x, y = smooth(table, v[0], v[1])
    if len(J):
        cosine, sine = math.cos(v[2]), math.sin(v[2])
        J[0, 0], J[0, 1], J[0, 2] = cosine * x + sine * y, cosine * y - sine * x, 0.0


def wall_distance(field: SmoothField) -> Residual:
    """``wall_distance(field)(x)``: signed distance of each SE(2) position to the nearest wall, (n, 1) [m]."""
    return residual(Kernel(_wall_distance, (SE2,), 1, field.table, "wall distance"))


@compiled
def _short(d: float, numbers: Array) -> tuple[float, float]:
    """max(0, margin - distance)."""
    short = numbers[0] - d
    return 0.0 if short <= 0.0 else short, -1.0 if d < numbers[0] else 0.0  # NaN stays


def _shortfall(margin: float, d: Array) -> Array:
    short: Array = np.maximum(margin - d, 0.0)
    return short


def shortfall(distance: Residual, margin: float) -> Residual:
    """Turn a clearance into a soft margin: max(0, margin - distance), same shape, in metres.

    Args:
        distance: a clearance, such as ``disc_clearance``.
        margin: distance below which the cost begins [m]; its square is continuously differentiable there.
    """
    return of_distance(distance, _short, [margin], f"{distance.name} margin", partial(_shortfall, margin))
