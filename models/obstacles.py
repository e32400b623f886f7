"""Clearance from discs and from the walls of a map, as hard constraints and as soft margins."""

from __future__ import annotations

import math

from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE2
from unifg.models.distance_map import SmoothField, smooth
from unifg.models.profile import of_distance
from unifg.typing import Array

NEAR = 1e-9  # below this distance the direction to the centre is undefined; the gradient is taken as zero


@compiled
def _in_body(cosine: float, sine: float, x: float, y: float, row: int, J: Array) -> None:
    """Write the derivative along a pose of what has the gradient (x, y) in the world."""
    J[row, 0] = cosine * x + sine * y
    J[row, 1] = cosine * y - sine * x
    J[row, 2] = 0.0


@compiled
def _disc_clearance(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Write |x - c| - radius for all discs; p holds M centres, then M radii."""
    count, cosine, sine = len(r), 1.0, 0.0
    if len(J):
        cosine, sine = math.cos(v[2]), math.sin(v[2])
    for k in range(count):
        x, y = v[0] - p[2 * k], v[1] - p[2 * k + 1]
        distance = math.sqrt(x * x + y * y)
        r[k] = distance - p[2 * count + k]
        if len(J):
            scale = 1.0 / NEAR if distance < NEAR else 1.0 / distance
            _in_body(cosine, sine, scale * x, scale * y, k, J)


@compiled
def _disc_clearance_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Hessian of w' (|x - c| - radius): across the direction to the centre, and along the arc of the pose."""
    count, cosine, sine = len(w), math.cos(v[2]), math.sin(v[2])
    for i in range(len(S)):
        for k in range(len(S)):
            S[i, k] = 0.0
    pull_x = pull_y = 0.0
    for k in range(count):
        x, y = v[0] - p[2 * k], v[1] - p[2 * k + 1]
        distance = math.sqrt(x * x + y * y)
        if distance < NEAR:
            continue
        x, y = x / distance, y / distance
        pull_x += w[k] * x
        pull_y += w[k] * y
        scale, ahead, aside = w[k] / distance, cosine * x + sine * y, cosine * y - sine * x
        S[0, 0] += scale * aside * aside
        S[0, 1] -= scale * ahead * aside
        S[1, 1] += scale * ahead * ahead
    S[0, 2] = 0.5 * (cosine * pull_y - sine * pull_x)
    S[1, 2] = -0.5 * (cosine * pull_x + sine * pull_y)
    S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]


def _discs(centre: tuple[int, ...], radius: tuple[int, ...]) -> int:
    if centre != (*radius, 2):
        raise GraphError(
            f"disc clearance: centre must be (M, 2) or (n, M, 2) and radius (M,) or (n, M), found {centre} and "
            f"{radius} for each pose"
        )
    return centre[0]


disc_clearance = residual(
    Kernel(_disc_clearance, (SE2, 2, 1), _discs, name="disc clearance", second=_disc_clearance_second),
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
        _in_body(math.cos(v[2]), math.sin(v[2]), x, y, 0, J)


def wall_distance(field: SmoothField) -> Residual:
    """``wall_distance(field)(x)``: signed distance of each SE(2) position to the nearest wall, (n, 1) [m]."""
    return residual(Kernel(_wall_distance, (SE2,), 1, field.table, "wall distance"))


@compiled
def _short(d: float, numbers: Array) -> tuple[float, float, float]:
    """max(0, margin - distance)."""
    short = numbers[0] - d
    return 0.0 if short <= 0.0 else short, -1.0 if d < numbers[0] else 0.0, 0.0  # NaN stays


def shortfall(distance: Residual, margin: float) -> Residual:
    """Turn a clearance into a soft margin: max(0, margin - distance), same shape, in metres.

    Args:
        distance: a residual with an attached Jacobian, such as ``disc_clearance``.
        margin: distance below which the cost begins [m]; its square is continuously differentiable there.
    """
    return of_distance(distance, _short, [margin], f"{distance.name} margin")
