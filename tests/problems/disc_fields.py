"""Random fields of twenty discs with residuals a user writes.

A unicycle, forty steps, hard dynamics, a soft goal and the guess a user begins with: the straight line through the
discs. Dynamics and clearance are compiled functions without Jacobian.
"""

from __future__ import annotations

import math

import numba
import numpy as np

import unifg as fg
from unifg.typing import Array

HORIZON = 40
DT = 0.2  # [s]
LENGTH = 6.0  # from start to goal [m]
DISCS = 20
RADII = (0.15, 0.4)  # hull of the robot included [m]
CLEAR = 0.6  # around start and goal [m]
TOLERANCE = 1e-6
LIMITS = np.array([1.5, 2.0])  # of the controls [m/s, rad/s]
GOAL = np.array([50.0, 50.0, 1.0])  # weights of the last pose
EFFORT = np.array([0.1, 0.1])


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def gap(x: Array, u: Array, y: Array, dt: float, r: Array) -> None:
    """A unicycle whose turn is held over the step, by the midpoint rule."""
    heading = x[2] + 0.5 * dt * u[1]
    r[0] = y[0] - x[0] - dt * u[0] * math.cos(heading)
    r[1] = y[1] - x[1] - dt * u[0] * math.sin(heading)
    r[2] = y[2] - x[2] - dt * u[1]


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def clearance(x: Array, discs: Array, r: Array) -> None:
    """Squared distance to every disc's centre less its squared radius."""
    for k in range(len(r)):
        dx, dy = x[0] - discs[3 * k], x[1] - discs[3 * k + 1]
        r[k] = dx * dx + dy * dy - discs[3 * k + 2] ** 2


def layout(seed: int) -> Array:
    """(DISCS, 3) x, y, radius [m]; they may overlap, start and goal are free."""
    rng = np.random.default_rng(seed)
    discs: list[list[float]] = []
    while len(discs) < DISCS:
        x, y, radius = rng.uniform(0.0, LENGTH), rng.uniform(-2.0, 2.0), rng.uniform(*RADII)
        if min(math.hypot(x, y), math.hypot(x - LENGTH, y)) > radius + CLEAR:
            discs.append([x, y, radius])
    return np.array(discs)


def guess() -> tuple[Array, Array]:
    """The straight line at constant speed: states (N + 1, 3) and controls (N, 2)."""
    states, controls = np.zeros((HORIZON + 1, 3)), np.zeros((HORIZON, 2))
    states[:, 0] = np.linspace(0.0, LENGTH, HORIZON + 1)
    controls[:, 0] = LENGTH / (HORIZON * DT)
    return states, controls


class Field:
    """The fields for one of our backends: one structure, discs as data.

    Attributes:
        x, u: states and controls.
    """

    def __init__(self, solver: fg.Solver) -> None:
        """State the problem."""
        graph = fg.Graph()
        self.x = x = graph.variables("pose", fg.Rn(3), HORIZON + 1)
        self.u = u = graph.variables("control", fg.Rn(2), HORIZON)
        self._discs = graph.data("discs", layout(0).ravel())
        graph.fix(x[0], np.zeros(3))
        graph.minimize(fg.prior, u, np.zeros(2), sigma=EFFORT**-0.5, name="effort")
        graph.minimize(fg.prior, x[-1], [LENGTH, 0.0, 0.0], sigma=GOAL**-0.5, name="goal")
        motion = fg.residual(gap, rows=3)
        graph.constrain(motion, x[:-1], u, x[1:], DT, lower=0.0, upper=0.0, name="motion")
        graph.bound(u, lower=-LIMITS, upper=LIMITS, name="limits")
        away = fg.residual(clearance, rows=DISCS)
        graph.constrain(away, x[1:], self._discs, lower=0.0, name="discs")
        self._run = solver.prepare(graph)

    def solve(self, discs: Array) -> fg.Solution:
        """Solve one field from the straight line."""
        states, controls = guess()
        return self._run.solve({self.x: states, self.u: controls}, data={self._discs: discs.ravel()})
