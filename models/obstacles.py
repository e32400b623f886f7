"""Clearance from discs and from the walls of a map, as hard constraints and as soft margins."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from unifg.codegen.calls import vector
from unifg.codegen.jit import compiled
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE2
from unifg.models.avoidance import count, to_balls
from unifg.models.distance_map import SmoothField, smooth
from unifg.models.footprint import Body
from unifg.models.planar import POSE
from unifg.models.profile import of_distance
from unifg.typing import Array

__all__ = ["disc_clearance", "shortfall", "wall_distance"]

TAKES = POSE, "m in W", "m"  # units and frames of pose, centres and radii

disc_clearance = residual(
    StatedKernel(to_balls, (SE2, 2, 1), partial(count, "disc clearance", 2, "pose"), name="disc clearance"),
    takes=TAKES,
    about="""``disc_clearance(x, centre, radius)``: |p - c| - r [m], one column per disc, (n, M).

x: (n, 3) SE(2) poses. centre: (M, 2) shared by all poses or (n, M, 2), one set for each, as for moving discs.
radius: (M,) or (n, M); give the sum of the disc's and the robot's radii for hull clearance.
""",
)


def clearance_of(body: Body) -> Residual:
    """``disc_clearance`` of every disc of a body, (n, K M), disc by disc; smaller ones count as if they were larger.

    The rows of a disc that is smaller than the largest are greater by the difference: what has to be kept is the same
    for all of them.
    """
    if body.round:
        return disc_clearance
    table = [(x, y, less) for (x, y, _), less in zip(body.discs, body.smaller.tolist(), strict=True)]

    def of_body(x: Array, centre: Array, radius: Array) -> Array:
        rows = [to_balls(SE2.act(x, np.array([[ahead, aside]])), centre, radius) + less for ahead, aside, less in table]
        return np.concatenate(rows, axis=1)

    def rows_of(centre: tuple[int, ...], radius: tuple[int, ...]) -> int:
        return len(table) * count("disc clearance", 2, "pose", centre, radius)

    return residual(StatedKernel(of_body, (SE2, 2, 1), rows_of, name="disc clearance of a body"), takes=TAKES)


@compiled
def _wall_distance(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Smoothed distance of a position to the nearest wall."""
    r[0], x, y = smooth(table, v[0], v[1])
    if len(J):
        cosine, sine = math.cos(v[2]), math.sin(v[2])
        J[0, 0], J[0, 1], J[0, 2] = cosine * x + sine * y, cosine * y - sine * x, 0.0


@compiled
def _body_distance(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """The same of the discs of a body; in front of the map their number, then x, y and what is added of each."""
    discs = int(table[0])
    walls = vector(table, 1 + 3 * discs, len(table) - 1 - 3 * discs)
    cosine, sine = math.cos(v[2]), math.sin(v[2])
    for k in range(discs):
        ahead, left = table[1 + 3 * k], table[2 + 3 * k]
        distance, x, y = smooth(walls, v[0] + cosine * ahead - sine * left, v[1] + sine * ahead + cosine * left)
        r[k] = distance + table[3 + 3 * k]
        if len(J):
            along, across = cosine * x + sine * y, cosine * y - sine * x
            J[k, 0], J[k, 1], J[k, 2] = along, across, ahead * across - left * along


def wall_distance(field: SmoothField, body: Body | None = None) -> Residual:
    """``wall_distance(field)(x)``: signed distance of each SE(2) position to the nearest wall, (n, 1) [m].

    With a body: of the centres of its discs, (n, K), those of smaller ones greater by the difference to the largest.
    """
    if body is None or body.round:
        return residual(Kernel(_wall_distance, (SE2,), 1, field.table, "wall distance"))
    discs = np.column_stack([np.array(body.discs)[:, :2], body.smaller])
    table = np.concatenate([[float(len(discs))], discs.ravel(), field.table])
    return residual(Kernel(_body_distance, (SE2,), len(discs), table, "wall distance of a body"))


@compiled
def _short(d: float, numbers: Array) -> tuple[float, float]:
    """max(0, margin - distance)."""
    short = numbers[0] - d
    return 0.0 if short <= 0.0 else short, -1.0 if d < numbers[0] else 0.0  # NaN stays


def _shortfall(margin: float, d: Array) -> Array:
    return np.maximum(margin - d, 0.0)


def _falling(margin: float, d: Array) -> Array:
    return np.where(d < margin, -1.0, 0.0)


def shortfall(distance: Residual, margin: float) -> Residual:
    """Turn a clearance into a soft margin: max(0, margin - distance), same shape, in metres.

    Args:
        distance: a clearance, such as ``disc_clearance``.
        margin: distance below which the cost begins [m]; its square is continuously differentiable there.
    """
    plain = partial(_shortfall, margin), partial(_falling, margin)
    return of_distance(distance, _short, [margin], f"{distance.name} margin", *plain)
