"""Parallel parkings of a kinematic bicycle from rest into random gaps.

A car that stands still cannot move sideways, and at rest its wheels steer nothing: the linearised dynamics of the guess
(the car stands where it is, or slides along a straight line) do not reach the goal. A solver has to find its way from
there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numba
import numpy as np

import unifg as fg
from problems.graphs import graph_of
from unifg.typing import Array

HORIZON, DT = 50, 0.2  # steps, [s]
BASE = 2.7  # wheelbase [m]
HULL = np.array([-0.6, 0.65, 1.95, 3.2])  # centres of the discs that cover a car, ahead of its rear axle [m]
RADIUS = 0.95  # of those discs [m]
LIMITS = np.array([2.0, 0.6])  # acceleration [m/s^2] and steering angle [rad]
FASTEST = 3.0  # [m/s]
EFFORT = np.array([1.0, 1.0])
Guess: TypeAlias = Literal["rest", "line"]


@dataclass(frozen=True)
class Layout:
    """One parking.

    Attributes:
        start: (4,) pose of the rear axle and speed [m, m, rad, m/s].
        goal: (4,) the same, to be met exactly.
        cars: (K, 2) centres of the discs that cover the parked cars [m]; none for an empty street.
    """

    start: Array
    goal: Array
    cars: Array


def layout(seed: int, cars: bool = True) -> Layout:
    """Draw the length of the gap, the place beside it where the car stands, and how it stands there."""
    rng = np.random.default_rng(seed)
    spare = rng.uniform(1.6, 3.0)  # the gap is longer than the car by this [m]
    start = np.array([rng.uniform(0.0, 6.0), rng.uniform(2.4, 3.4), rng.uniform(-0.15, 0.15), 0.0])
    length = HULL[-1] - HULL[0] + 2.0 * RADIUS
    ahead, behind = HULL + length + 0.5 * spare, HULL - length - 0.5 * spare
    parked = np.concatenate([behind, ahead])
    parked = np.column_stack([parked, rng.uniform(-0.1, 0.1, 2).repeat(len(HULL))])
    return Layout(start, np.zeros(4), parked if cars else parked[:0])


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def gap(x: Array, u: Array, y: Array, dt: float, base: float, r: Array) -> None:
    """A kinematic bicycle about its rear axle, by the midpoint rule."""
    v = x[3] + 0.5 * dt * u[0]
    turn = dt * v * math.tan(u[1]) / base
    heading = x[2] + 0.5 * turn
    r[0] = y[0] - x[0] - dt * v * math.cos(heading)
    r[1] = y[1] - x[1] - dt * v * math.sin(heading)
    r[2] = y[2] - x[2] - turn
    r[3] = y[3] - x[3] - dt * u[0]


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def clearance(x: Array, hull: Array, cars: Array, least: float, r: Array) -> None:
    """Squared distance of every disc of the car to every disc of the parked ones, less the least one's square."""
    c, s = math.cos(x[2]), math.sin(x[2])
    for i in range(len(hull)):
        px, py = x[0] + hull[i] * c, x[1] + hull[i] * s
        for k in range(len(cars) // 2):
            dx, dy = px - cars[2 * k], py - cars[2 * k + 1]
            r[i * (len(cars) // 2) + k] = dx * dx + dy * dy - least * least


def guess(drawn: Layout, kind: Guess) -> tuple[Array, Array]:
    """States (N + 1, 4) and controls (N, 2): the car stands at the start, or slides straight to the goal."""
    share = np.linspace(0.0, 1.0, HORIZON + 1)[:, None] if kind == "line" else np.zeros((HORIZON + 1, 1))
    return drawn.start + share * (drawn.goal - drawn.start), np.zeros((HORIZON, 2))


class Parking:
    """The parking for one of our backends: one structure, start, goal and cars as data.

    Attributes:
        x, u: states and controls.
    """

    def __init__(self, solver: fg.Solver, cars: bool = True) -> None:
        """State the problem."""
        drawn = layout(0, cars)
        graph = fg.Graph()
        self.graph = graph
        self.x = x = graph.variables("state", fg.Rn(4), HORIZON + 1)
        self.u = u = graph.variables("control", fg.Rn(2), HORIZON)
        self._start, self._goal = graph.data("start", drawn.start), graph.data("goal", drawn.goal)
        graph.fix(x[0], self._start)
        graph.minimize(fg.prior, u, np.zeros(2), sigma=EFFORT**-0.5, name="effort")
        motion = fg.residual(gap, rows=4)
        graph.constrain(motion, x[:-1], u, x[1:], DT, BASE, lower=0.0, upper=0.0, name="motion")
        graph.constrain(fg.prior, x[-1], self._goal, lower=0.0, upper=0.0, name="goal")
        graph.bound(u, lower=-LIMITS, upper=LIMITS, name="limits")
        fast = np.array([np.inf, np.inf, np.inf, FASTEST])
        graph.bound(x[1:-1], lower=-fast, upper=fast, name="speed")
        self._cars = None
        if cars:
            self._cars = graph.data("cars", drawn.cars.ravel())
            away = fg.residual(clearance, rows=len(HULL) * len(drawn.cars))
            graph.constrain(away, x[1:-1], HULL, self._cars, 2.0 * RADIUS, lower=0.0, name="cars")
        self._run = solver.prepare(graph)

    def solve(self, drawn: Layout, kind: Guess, **options: Any) -> fg.Solution:
        """Solve one parking from a guess, with options of :meth:`unifg.solution.solver.Prepared.solve`."""
        states, controls = guess(drawn, kind)
        data: dict[fg.Data, Array] = {self._start: drawn.start, self._goal: drawn.goal}
        if self._cars is not None:
            data[self._cars] = drawn.cars.ravel()
        return self._run.solve({self.x: states, self.u: controls}, data=data, **options)


def least_time(seed: int, cost: float = 1.0) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """A car that is to stand at the origin in least time, from a pose at random: x, y, heading, speed, steering.

    Args:
        seed: of the pose.
        cost: of a second.
    """
    count, start = 40, np.zeros(5)
    rng = np.random.default_rng(seed)
    start[:3] = rng.uniform([-6.0, 2.0, -np.pi], [6.0, 6.0, np.pi])

    def rate(x: Array, u: Array) -> Array:
        speed, turn = x[:, 3], x[:, 3] * np.tan(x[:, 4]) / 2.5
        return np.stack([speed * np.cos(x[:, 2]), speed * np.sin(x[:, 2]), turn, u[:, 0], u[:, 1]], axis=1)

    graph, x, u, time = graph_of(("x", fg.Rn(5), count + 1), ("u", fg.Rn(2), count), ("time", fg.Rn(1), 1))
    graph.minimize_scalar(lambda t: cost * t[:, 0], time)
    graph.minimize(fg.prior, u, np.zeros(2), sigma=10.0 * cost**-0.5)
    graph.fix(x[0], start)
    graph.constrain(
        lambda a, u, b, t: b - a - t / count * rate(0.5 * (a + b), u), x[:-1], u, x[1:], time[0], lower=0.0, upper=0.0
    )
    graph.constrain(fg.prior, x[-1], np.zeros(5), lower=0.0, upper=0.0, name="goal")
    graph.bound(u, lower=[-2.0, -1.0], upper=[2.0, 1.0])
    graph.bound(x[1:], lower=[-np.inf, -np.inf, -np.inf, -3.0, -0.6], upper=[np.inf, np.inf, np.inf, 3.0, 0.6])
    graph.bound(time, lower=1.0, upper=30.0)
    return graph, {x: np.linspace(start, 0.0, count + 1), u: np.zeros((count, 2)), time: np.array([[8.0]])}
