"""COPS 3.0 and textbook problems whose costs are times, ranges, heights and areas rather than sums of squares.

Formulas, data, meshes and starts are those of Dolan, More and Munson, Benchmarking Optimization Software with COPS 3.0,
Argonne National Laboratory ANL/MCS-TM-273 (2004). :func:`program` reads the same functions into symbols of CasADi.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import factorial, pi
from typing import Any, TypeAlias

import numpy as np
from numpy import cos, exp, sin, sqrt

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.typing import Array, IntArray

Stated: TypeAlias = tuple[fg.Graph, dict[fg.Family, Any]]

LEGENDRE = {
    1: [0.5],
    3: [0.11270166537926, 0.5, 0.88729833462074],
    4: [0.06943184420297, 0.33000947820757, 0.66999052179243, 0.93056815579703],
}


@dataclass(frozen=True)
class Problem:
    """A problem at one mesh.

    Attributes:
        name: of the problem.
        build: graph and guess.
        best: cost in the literature, as stated: negative where something is maximised.
        others: costs of known local optima that are no answers.
        mesh: what there is of it.
    """

    name: str
    build: Callable[[], Stated]
    best: float
    others: tuple[float, ...] = ()
    mesh: str = ""


def trapezoid(rate: Callable[..., Any]) -> Callable[..., Any]:
    """Defect of the trapezoidal rule over a step h of a hundredth (or whatever share) of the duration."""

    def defect(x: Any, u: Any, y: Any, v: Any, duration: Any, share: float) -> Any:
        return y - x - 0.5 * share * duration * (rate(x, u) + rate(y, v))

    return defect


def columns(*parts: Any) -> Any:
    """Numbers of every row side by side."""
    return np.stack(parts, axis=1)


def flight(
    rate: Callable[..., Any], steps: int, states: int, controls: int
) -> tuple[fg.Graph, fg.Family, fg.Family, fg.Family]:
    """Nodes of states and controls that follow a rate, and the duration."""
    graph, x, u, t = graph_of(
        ("x", fg.Rn(states), steps + 1), ("u", fg.Rn(controls), steps + 1), ("duration", fg.Rn(1), 1)
    )
    arguments = x[:-1], u[:-1], x[1:], u[1:], t, 1.0 / steps
    graph.constrain(trapezoid(rate), *arguments, lower=0.0, upper=0.0, name="dynamics")
    return graph, x, u, t


def polygon(corners: int) -> Stated:
    """Area of a polygon of unit diameter, in polar coordinates around its last corner."""
    graph, p = graph_with(fg.Rn(2), corners, "corner")  # radius and angle
    i, j = np.triu_indices(corners, 1)
    graph.constrain(
        lambda a, b: (a[:, 0] ** 2 + b[:, 0] ** 2 - 2.0 * a[:, 0] * b[:, 0] * cos(a[:, 1] - b[:, 1]))[:, None],
        p[i], p[j], upper=1.0, name="diameter",
    )  # fmt: skip
    graph.constrain(lambda a, b: b[:, 1:] - a[:, 1:], p[:-1], p[1:], lower=0.0, name="order")
    graph.bound(p, lower=[0.0, 0.0], upper=[1.0, pi], name="box")
    graph.fix(p[-1], [0.0, pi])
    graph.minimize_scalar(lambda a, b: -0.5 * a[:, 0] * b[:, 0] * sin(b[:, 1] - a[:, 1]), p[:-1], p[1:], name="area")
    k = np.arange(1.0, corners + 1.0)
    radius = 4.0 * k * (corners + 1.0 - k) / (corners + 1.0) ** 2
    radius[-1] = 0.0
    return graph, {p: np.column_stack([radius, pi * k / corners])}


def electrons(count: int) -> Stated:
    """Energy of charges on a sphere."""
    graph, p = graph_with(fg.Rn(3), count, "charge")
    i, j = np.triu_indices(count, 1)
    graph.constrain(lambda a: (a**2).sum(axis=1, keepdims=True), p, lower=1.0, upper=1.0, name="sphere")
    graph.minimize_scalar(lambda a, b: 1.0 / sqrt(((a - b) ** 2).sum(axis=1)), p[i], p[j], name="energy")
    draw = np.random.default_rng(0)
    a, b = 2.0 * pi * draw.random(count), pi * draw.random(count)
    return graph, {p: np.column_stack([cos(a) * sin(b), sin(a) * sin(b), cos(b)])}


def chain(steps: int) -> Stated:
    """Potential energy of a chain of length 4 between (0, 1) and (1, 3)."""
    graph, x, u = graph_of(("x", fg.Rn(3), steps + 1), ("slope", fg.Rn(1), steps + 1))

    def rate(x: Any, u: Any) -> Any:
        length = sqrt(1.0 + u[:, 0] ** 2)
        return columns(u[:, 0], x[:, 0] * length, length)

    graph.constrain(trapezoid(rate), x[:-1], u[:-1], x[1:], u[1:], 1.0, 1.0 / steps, lower=0.0, upper=0.0, name="shape")
    graph.fix(x[0], [1.0, 0.0, 0.0])
    graph.constrain(lambda end: end[:, [0, 2]], x[-1], lower=[3.0, 4.0], upper=[3.0, 4.0], name="end")
    graph.minimize_scalar(lambda end: end[:, 1], x[-1], name="energy")
    k = np.arange(1.0, steps + 2.0) / steps
    slope, height = 8.0 * (k - 0.25), 8.0 * k * (0.5 * k - 0.25) + 1.0
    return graph, {x: np.column_stack([height, height * slope, slope]), u: slope[:, None]}


def cam(count: int) -> Stated:
    """Valve opening of a convex cam."""
    graph, r = graph_with(fg.Rn(1), count, "radius")
    step, steepest = 2.0 * pi / (5.0 * (count + 1)), 1.5 * 2.0 * pi / (5.0 * (count + 1))

    def bent(a: Any, b: Any, c: Any) -> Any:
        return 2.0 * cos(step) * a * c - a * b - b * c

    graph.constrain(bent, r[:-2], r[1:-1], r[2:], upper=0.0, name="convex")
    graph.constrain(bent, 1.0, r[0], r[1], upper=0.0, name="first")
    graph.constrain(bent, 1.0, 1.0, r[0], upper=0.0, name="before")
    graph.constrain(bent, r[-2], r[-1], 2.0, upper=0.0, name="last")
    graph.constrain(lambda a: 2.0 * cos(step) * a**2 - 4.0 * a, r[-1], upper=0.0, name="after")
    graph.constrain(lambda a, b: b - a, r[:-1], r[1:], lower=-steepest, upper=steepest, name="steepness")
    lower, upper = np.ones(count), np.full(count, 2.0)
    upper[0], lower[-1] = 1.0 + steepest, 2.0 - steepest
    graph.bound(r, lower=lower[:, None], upper=upper[:, None], name="box")
    graph.minimize_scalar(lambda a: -pi / count * a[:, 0], r, name="opening")
    return graph, {r: np.full((count, 1), 1.5)}


class Collocation:
    """Polynomials on intervals: values and scaled derivatives at their beginnings."""

    def __init__(self, graph: fg.Graph, intervals: int, size: int, stages: int, end: float) -> None:
        """Declare the unknowns and join the intervals.

        Args:
            graph: to state it in.
            intervals: number of them.
            size: of the state.
            stages: collocation points of each.
            end: of the time, which begins at zero.
        """
        self.graph, self.intervals, self.size, self.stages = graph, intervals, size, stages
        self.h = end / intervals
        self.v = graph.variables("v", fg.Rn(size), intervals)
        self.w = graph.variables("w", fg.Rn(size * stages), intervals)
        graph.constrain(
            lambda v, w, after: self.end(v, w) - after,
            self.v[:-1],
            self.w[:-1],
            self.v[1:],
            lower=0.0,
            upper=0.0,
            name="joined",
        )

    def end(self, v: Any, w: Any) -> Any:
        """Values where intervals end."""
        return v + self.h * self._weighted(w, np.array([1.0 / factorial(k + 1) for k in range(self.stages)]))

    def _weighted(self, w: Any, factors: Array) -> Any:
        return sum(f * w[:, k * self.size : (k + 1) * self.size] for k, f in enumerate(factors))

    def follow(self, rate: Callable[..., Any], *parameters: Any) -> None:
        """Make derivatives at all collocation points what a rate of values, index of the point and parameters says."""
        points = LEGENDRE[self.stages]
        values = [np.array([rho ** (k + 1) / factorial(k + 1) for k in range(self.stages)]) for rho in points]
        slopes = [np.array([rho**k / factorial(k) for k in range(self.stages)]) for rho in points]

        def defects(v: Any, w: Any, *parameters: Any) -> Any:
            return np.concatenate(
                [
                    self._weighted(w, slope) - rate(v + self.h * self._weighted(w, value), j, *parameters)
                    for j, (value, slope) in enumerate(zip(values, slopes, strict=True))
                ],
                axis=1,
            )

        self.graph.constrain(defects, self.v, self.w, *parameters, lower=0.0, upper=0.0, name="rates")

    def fit(self, times: Array, measured: Array) -> IntArray:
        """Sum of squared differences from measurements; returns the interval of each."""
        at: IntArray = np.minimum(self.intervals - 1, np.floor(times / self.h).astype(int))
        late = times - at * self.h
        factors = np.array([[d ** (k + 1) / (factorial(k + 1) * self.h**k) for k in range(self.stages)] for d in late])

        def difference(v: Any, w: Any, factor: Any, z: Any) -> Any:
            m = self.size
            found = v - z
            for k in range(self.stages):
                found = found + factor[:, k : k + 1] * w[:, k * m : (k + 1) * m]
            return sqrt(2.0) * found

        self.graph.minimize(difference, self.v[at], self.w[at], fg.each(factors), fg.each(measured), name="fit")
        return at

    def steps(self, at: IntArray, first: Array, measured: Array) -> dict[fg.Family, Any]:
        """Guess that goes from one measurement to the next."""
        guess = np.empty((self.intervals, self.size))
        guess[: at[0] + 1] = first
        for j in range(1, len(at)):
            guess[at[j - 1] + 1 : at[j] + 1] = measured[j]
        guess[at[-1] + 1 :] = measured[-1]
        return {self.v: guess, self.w: np.zeros((self.intervals, self.size * self.stages))}


def pinene(intervals: int) -> Stated:
    """Five rates of the isomerisation of alpha-pinene."""
    times = np.array([1230.0, 3060.0, 4920.0, 7800.0, 10680.0, 15030.0, 22620.0, 36420.0])
    measured = np.array(
        [
            [88.35, 7.3, 2.3, 0.4, 1.75], [76.4, 15.6, 4.5, 0.7, 2.8], [65.1, 23.1, 5.3, 1.1, 5.8],
            [50.4, 32.9, 6.0, 1.5, 9.3], [37.5, 42.7, 6.0, 1.9, 12.0], [25.9, 49.1, 5.9, 2.2, 17.0],
            [14.0, 57.4, 5.1, 2.6, 21.0], [4.5, 63.1, 3.8, 2.9, 25.7],
        ]
    )  # fmt: skip
    graph = fg.Graph()
    path = Collocation(graph, intervals, 5, 3, times[-1])
    rates = graph.variables("rates", fg.Rn(5), 1)

    def rate(y: Any, _: int, p: Any) -> Any:
        a, b, c, d, e = (p[:, k] for k in range(5))
        away = d * y[:, 2] - e * y[:, 4]
        return columns(-(a + b) * y[:, 0], a * y[:, 0], b * y[:, 0] - (c * y[:, 2] + away), c * y[:, 2], away)

    path.follow(rate, rates)
    at = path.fit(times, measured)
    first = np.array([100.0, 0.0, 0.0, 0.0, 0.0])
    graph.fix(path.v[0], first)
    graph.bound(rates, lower=0.0, name="positive")
    return graph, {**path.steps(at, first, measured), rates: np.zeros((1, 5))}


MARINE = """20000 17000 10000 15000 12000 9000 7000 3000 12445 15411 13040 13338 13484 8426 6615 4022 7705 13074 14623
11976 12453 9272 6891 5020 4664 8579 12434 12603 11738 9710 6821 5722 2977 7053 11219 11340 13665 8534 6242 5695 1769
5054 10065 11232 12112 9600 6647 7034 943 3907 9473 10334 11115 8826 6842 7348 581 2624 7421 10297 12427 8747 7199 7684
355 1744 5369 7748 10057 8698 6542 7410 223 1272 4713 6869 9564 8766 6810 6961 137 821 3451 6050 8671 8291 6827 7525 87
577 2649 5454 8430 7411 6423 8388 49 337 2058 4115 7435 7627 6268 7189 32 228 1440 3790 6474 6658 5859 7467 17 168 1178
3087 6524 5880 5562 7144 11 99 919 2596 5360 5762 4480 7256 7 65 647 1873 4556 5058 4944 7538 4 44 509 1571 4009 4527
4233 6649 2 27 345 1227 3677 4229 3805 6378 1 20 231 934 3197 3695 3159 6454 1 12 198 707 2562 3163 3232 5566"""


def marine(intervals: int) -> Stated:
    """Growth and mortality of eight stages of a marine population."""
    measured = np.array(MARINE.split(), dtype=float).reshape(21, 8)
    times = np.linspace(0.0, 10.0, 21)
    graph = fg.Graph()
    path = Collocation(graph, intervals, 8, 1, 10.0)
    growth, mortality = graph.variables("growth", fg.Rn(7), 1), graph.variables("mortality", fg.Rn(8), 1)

    def rate(y: Any, _: int, g: Any, m: Any) -> Any:
        parts = [-(m[:, 0] + g[:, 0]) * y[:, 0]]
        parts += [g[:, s - 1] * y[:, s - 1] - (m[:, s] + g[:, s]) * y[:, s] for s in range(1, 7)]
        return columns(*parts, g[:, 6] * y[:, 6] - m[:, 7] * y[:, 7])

    path.follow(rate, growth, mortality)
    at = path.fit(times, measured)
    graph.bound(growth, lower=0.0, name="growing")
    graph.bound(mortality, lower=0.0, name="dying")
    return graph, {**path.steps(at, measured[0], measured), growth: np.zeros((1, 7)), mortality: np.zeros((1, 8))}


def channel(intervals: int) -> Stated:
    """Flow in a channel at Reynolds number 10, a boundary value problem of fourth order without a cost."""
    graph = fg.Graph()
    h, points, order, stages = 1.0 / intervals, LEGENDRE[4], 4, 4
    v = graph.variables("v", fg.Rn(order), intervals)
    w = graph.variables("w", fg.Rn(stages), intervals)

    def derivatives(v: Any, w: Any, rho: float) -> list[Any]:
        found = []
        for s in range(order):
            value = sum(v[:, k] * ((rho * h) ** (k - s) / factorial(k - s)) for k in range(s, order))
            rest = sum(w[:, k] * (rho ** (k + order - s) / factorial(k + order - s)) for k in range(stages))
            found.append(value + h ** (order - s) * rest)
        return found

    def flow(v: Any, w: Any) -> Any:
        rows = []
        for rho in points:
            a, b, c, d = derivatives(v, w, rho)
            highest = sum(w[:, k] * (rho**k / factorial(k)) for k in range(stages))
            rows.append(highest - 10.0 * (b * c - a * d))
        return columns(*rows)

    graph.constrain(flow, v, w, lower=0.0, upper=0.0, name="flow")
    graph.constrain(
        lambda v, w, after: columns(*derivatives(v, w, 1.0)) - after,
        v[:-1], w[:-1], v[1:], lower=0.0, upper=0.0, name="joined",
    )  # fmt: skip
    graph.constrain(lambda v: v[:, :2], v[0], lower=0.0, upper=0.0, name="begin")
    graph.constrain(
        lambda v, w: columns(*derivatives(v, w, 1.0)[:2]), v[-1], w[-1], lower=[1.0, 0.0], upper=[1.0, 0.0], name="end"
    )
    graph.minimize_scalar(lambda v: 0.0 * v[:, 0] + 1.0, v[0], name="constant")
    t = np.arange(intervals) * h
    guess = np.column_stack([t**2 * (3 - 2 * t), 6 * t * (1 - t), 6 * (1 - 2 * t), np.full(intervals, -12.0)])
    return graph, {v: guess, w: np.zeros((intervals, stages))}


def robot(steps: int) -> Stated:
    """Time of a robot arm: reach, two angles, and their speeds."""

    def rate(x: Any, u: Any) -> Any:
        inertia = ((5.0 - x[:, 0]) ** 3 + x[:, 0] ** 3) / 3.0
        return columns(
            x[:, 3], x[:, 4], x[:, 5], u[:, 0] / 5.0, u[:, 1] / (inertia * sin(x[:, 2]) ** 2), u[:, 2] / inertia
        )

    graph, x, u, t = flight(rate, steps, 6, 3)
    graph.fix(x[0], [4.5, 0.0, pi / 4, 0.0, 0.0, 0.0])
    graph.fix(x[-1], [4.5, 2.0 * pi / 3, pi / 4, 0.0, 0.0, 0.0])
    inf = np.inf
    graph.bound(x, lower=[0.0, -pi, 0.0, -inf, -inf, -inf], upper=[5.0, pi, pi, inf, inf, inf], name="box")
    graph.bound(u, lower=-1.0, upper=1.0, name="effort")
    graph.bound(t, lower=0.0, name="later")
    graph.minimize_scalar(lambda t: t[:, 0], t, name="time")
    k = np.linspace(0.0, 1.0, steps + 1)
    states = np.column_stack(
        [np.full(steps + 1, 4.5), 2 * pi / 3 * k**2, np.full(steps + 1, pi / 4), 0 * k, 4 * pi / 3 * k, 0 * k]
    )
    return graph, {x: states, u: np.zeros((steps + 1, 3)), t: [[1.0]]}


def steering(steps: int) -> Stated:
    """Time of a particle with constant thrust to a height of 5 and a velocity of (45, 0)."""

    def rate(x: Any, u: Any) -> Any:
        return columns(x[:, 2], x[:, 3], 100.0 * cos(u[:, 0]), 100.0 * sin(u[:, 0]))

    graph, x, u, t = flight(rate, steps, 4, 1)
    graph.fix(x[0], np.zeros(4))
    graph.constrain(lambda end: end[:, 1:], x[-1], lower=[5.0, 45.0, 0.0], upper=[5.0, 45.0, 0.0], name="end")
    graph.bound(u, lower=-pi / 2, upper=pi / 2, name="angle")
    graph.bound(t, lower=0.0, name="later")
    graph.minimize_scalar(lambda t: t[:, 0], t, name="time")
    k = np.linspace(0.0, 1.0, steps + 1)
    return graph, {x: np.column_stack([0 * k, 5 * k, 45 * k, 0 * k]), u: np.zeros((steps + 1, 1)), t: [[1.0]]}


def rocket(steps: int) -> Stated:
    """Height of Goddard's rocket."""

    def rate(x: Any, u: Any) -> Any:
        h, v, m, thrust = x[:, 0], x[:, 1], x[:, 2], u[:, 0]
        drag = 310.0 * v**2 * exp(-500.0 * (h - 1.0))
        return columns(v, (thrust - drag) / m - 1.0 / h**2, -2.0 * thrust)

    graph, x, u, t = flight(rate, steps, 3, 1)
    graph.fix(x[0], [1.0, 0.0, 1.0])
    graph.constrain(lambda end: end[:, 2:], x[-1], lower=0.6, upper=0.6, name="burnt")
    graph.bound(x, lower=[1.0, 0.0, 0.6], upper=[np.inf, np.inf, 1.0], name="box")
    graph.bound(u, lower=0.0, upper=3.5, name="thrust")
    graph.bound(t, lower=0.0, name="later")
    graph.minimize_scalar(lambda end: -end[:, 0], x[-1], name="height")
    k = np.linspace(0.0, 1.0, steps + 1)
    return graph, {
        x: np.column_stack([1 + 0 * k, k * (1 - k), 1 - 0.4 * k]), u: np.full((steps + 1, 1), 1.75), t: [[1.0]],
    }  # fmt: skip


def glider(steps: int) -> Stated:
    """Range of a hang glider through a thermal."""

    def rate(x: Any, u: Any) -> Any:
        r = (x[:, 0] / 100.0 - 2.5) ** 2
        rise = x[:, 3] - 2.5 * (1.0 - r) * exp(-r)
        speed = sqrt(x[:, 2] ** 2 + rise**2)
        force = 0.5 * 1.13 * 14.0 * speed**2
        drag, lift = (0.034 + 0.069662 * u[:, 0] ** 2) * force, u[:, 0] * force
        along, up = x[:, 2] / speed, rise / speed
        return columns(x[:, 2], x[:, 3], (-lift * up - drag * along) / 100.0, (lift * along - drag * up) / 100.0 - 9.81)

    graph, x, u, t = flight(rate, steps, 4, 1)
    graph.fix(x[0], [0.0, 1000.0, 13.23, -1.288])
    wanted = [900.0, 13.23, -1.288]
    graph.constrain(lambda end: end[:, 1:], x[-1], lower=wanted, upper=wanted, name="end")
    graph.bound(x, lower=[0.0, -np.inf, 0.0, -np.inf], name="box")
    graph.bound(u, lower=0.0, upper=1.4, name="lift")
    graph.bound(t, lower=0.0, name="later")
    graph.minimize_scalar(lambda end: -end[:, 0], x[-1], name="range")
    k = np.linspace(0.0, 1.0, steps + 1)
    states = np.column_stack([13.23 * k, 1000 - 100 * k, 13.23 + 0 * k, -1.288 + 0 * k])
    return graph, {x: states, u: np.full((steps + 1, 1), 0.7), t: [[1.0]]}


def gas_oil(intervals: int) -> Stated:
    """Three rates of the cracking of gas oil."""
    times = np.array(
        [0, 25, 50, 75, 100, 125, 150, 175, 200, 225, 250, 300, 350, 400, 450, 500, 550, 650, 750, 850, 950]
    ) / 1000  # fmt: skip
    first = [
        1.0, 0.8105, 0.6208, 0.5258, 0.4345, 0.3903, 0.3342, 0.3034, 0.2735, 0.2405, 0.2283, 0.2071, 0.1669, 0.1530,
        0.1339, 0.1265, 0.1200, 0.0990, 0.0870, 0.0770, 0.0690,
    ]  # fmt: skip
    second = [
        0.0, 0.2000, 0.2886, 0.3010, 0.3215, 0.3123, 0.2716, 0.2551, 0.2258, 0.1959, 0.1789, 0.1457, 0.1198, 0.0909,
        0.0719, 0.0561, 0.0460, 0.0280, 0.0190, 0.0140, 0.0100,
    ]  # fmt: skip
    measured = np.column_stack([first, second])
    graph = fg.Graph()
    path = Collocation(graph, intervals, 2, 4, times[-1])
    rates = graph.variables("rates", fg.Rn(3), 1)

    def rate(y: Any, _: int, p: Any) -> Any:
        square = y[:, 0] ** 2
        return columns(-(p[:, 0] + p[:, 2]) * square, p[:, 0] * square - p[:, 1] * y[:, 1])

    path.follow(rate, rates)
    at = path.fit(times, measured)
    graph.fix(path.v[0], measured[0])
    graph.bound(rates, lower=0.0, name="positive")
    return graph, {**path.steps(at, measured[0], measured), rates: np.zeros((1, 3))}


METHANOL = """0 1 0 0 0.05 0.7085 0.1621 0.0811 0.065 0.5971 0.1855 0.0965 0.08 0.5537 0.1989 0.1198
0.123 0.3684 0.2845 0.1535 0.233 0.1712 0.3491 0.2097 0.273 0.1198 0.3098 0.2628 0.354 0.0747 0.3576 0.2467
0.397 0.0529 0.3347 0.2884 0.418 0.0415 0.3388 0.2757 0.502 0.0261 0.3557 0.3167 0.553 0.0208 0.3483 0.2954
0.681 0.0085 0.3836 0.295 0.75 0.0053 0.3611 0.2937 0.916 0.0019 0.3609 0.2831 0.937 0.0018 0.3485 0.2846
1.122 0.0006 0.3698 0.2899"""


def methanol(intervals: int) -> Stated:
    """Five rates of the conversion of methanol to hydrocarbons."""
    rows = np.array(METHANOL.split(), dtype=float).reshape(17, 4)
    times, measured = rows[:, 0], rows[:, 1:]
    graph = fg.Graph()
    path = Collocation(graph, intervals, 3, 3, times[-1])
    rates = graph.variables("rates", fg.Rn(5), 1)

    def rate(y: Any, _: int, p: Any) -> Any:
        a, b = y[:, 0], y[:, 1]
        below = (p[:, 1] + p[:, 4]) * a + b
        return columns(
            -(2.0 * p[:, 1] - p[:, 0] * b / below + p[:, 2] + p[:, 3]) * a,
            p[:, 0] * a * (p[:, 1] * a - b) / below + p[:, 2] * a,
            p[:, 0] * a * (b + p[:, 4] * a) / below + p[:, 3] * a,
        )

    path.follow(rate, rates)
    path.fit(times, measured)
    graph.fix(path.v[0], [1.0, 0.0, 0.0])
    graph.bound(rates, lower=0.0, name="positive")
    return graph, {
        path.v: np.full((intervals, 3), 1e-3), path.w: np.zeros((intervals, 9)), rates: np.ones((1, 5)),
    }  # fmt: skip


def catalyst(intervals: int) -> Stated:
    """Yield of a mixture of two catalysts along a tube."""
    graph = fg.Graph()
    path = Collocation(graph, intervals, 2, 3, 1.0)
    u = graph.variables("mixture", fg.Rn(3), intervals)

    def rate(y: Any, j: int, u: Any) -> Any:
        turned = u[:, j] * (10.0 * y[:, 1] - y[:, 0])
        return columns(turned, -turned - (1.0 - u[:, j]) * y[:, 1])

    path.follow(rate, u)
    graph.fix(path.v[0], [1.0, 0.0])
    graph.bound(u, lower=0.0, upper=1.0, name="share")
    graph.minimize_scalar(lambda v, w: path.end(v, w).sum(axis=1) - 1.0, path.v[-1], path.w[-1], name="yield")
    return graph, {
        path.v: np.tile([1.0, 0.0], (intervals, 1)), path.w: np.zeros((intervals, 6)), u: np.zeros((intervals, 3)),
    }  # fmt: skip


def grid(nx: int, ny: int) -> tuple[fg.Graph, fg.Family, IntArray]:
    """Heights at (nx + 2) x (ny + 2) nodes, and their numbers."""
    graph, v = graph_with(fg.Rn(1), (nx + 2) * (ny + 2), "height")
    return graph, v, np.arange((nx + 2) * (ny + 2)).reshape(nx + 2, -1)


def triangles(v: fg.Family, at: IntArray) -> list[tuple[Any, Any, Any, IntArray]]:
    """Corner, neighbour along x, neighbour along y, and the corner's x index, of lower and upper triangles."""
    i = np.broadcast_to(np.arange(len(at))[:, None], at.shape)
    lower = v[at[:-1, :-1].ravel()], v[at[1:, :-1].ravel()], v[at[:-1, 1:].ravel()], i[:-1, :-1].ravel()
    upper = v[at[1:, 1:].ravel()], v[at[:-1, 1:].ravel()], v[at[1:, :-1].ravel()], i[1:, 1:].ravel()
    return [lower, upper]


def edge(at: IntArray) -> IntArray:
    """Numbers of the nodes on the border."""
    return np.unique(np.concatenate([at[0], at[-1], at[:, 0], at[:, -1]]))


def torsion(nx: int, ny: int) -> Stated:
    """Elastic-plastic torsion."""
    graph, v, at = grid(nx, ny)
    hx, hy = 1.0 / (nx + 1), 1.0 / (ny + 1)
    x, y = np.minimum(np.arange(nx + 2), nx + 1 - np.arange(nx + 2)), np.arange(ny + 2)
    far = np.minimum(x[:, None] * hx, np.minimum(y, ny + 1 - y) * hy).ravel()

    def energy(a: Any, b: Any, c: Any) -> Any:
        squares = ((b[:, 0] - a[:, 0]) / hx) ** 2 + ((c[:, 0] - a[:, 0]) / hy) ** 2
        return 0.5 * hx * hy * (0.5 * squares - 5.0 / 3.0 * (a[:, 0] + b[:, 0] + c[:, 0]))

    for name, (a, b, c, _) in zip(("lower", "upper"), triangles(v, at), strict=True):
        graph.minimize_scalar(energy, a, b, c, name=name)
    inner = np.setdiff1d(at, edge(at))
    graph.fix(v[edge(at)], 0.0)
    graph.bound(v[inner], lower=-far[inner, None], upper=far[inner, None], name="yield")
    return graph, {v: far[:, None]}


def bearing(nx: int, ny: int) -> Stated:
    """Pressure in a journal bearing."""
    graph, v, at = grid(nx, ny)
    hx, hy, e = 2.0 * pi / (nx + 1), 20.0 / (ny + 1), 0.1
    wide = (1.0 + e * cos(np.arange(-1, nx + 3) * hx)) ** 3

    def energy(a: Any, b: Any, c: Any, weight: Any) -> Any:
        squares = ((b[:, 0] - a[:, 0]) / hx) ** 2 + ((c[:, 0] - a[:, 0]) / hy) ** 2
        return hx * hy / 12.0 * weight * squares

    for name, own, side, (a, b, c, i) in zip(("lower", "upper"), (1.0, 2.0), (1, -1), triangles(v, at), strict=True):
        graph.minimize_scalar(energy, a, b, c, fg.each(own * wide[i + 1] + 2.0 * wide[i + 1 + side]), name=name)
    pull = np.repeat(hx * hy * e * sin(np.arange(nx + 2) * hx), ny + 2)
    graph.minimize_scalar(lambda v, pull: -pull * v[:, 0], v, fg.each(pull), name="load")
    inner = np.setdiff1d(at, edge(at))
    graph.fix(v[edge(at)], 0.0)
    graph.bound(v[inner], lower=0.0, name="pressure")
    return graph, {v: np.repeat(np.maximum(sin(np.arange(nx + 2) * hx), 0.0), ny + 2)[:, None]}


def surface(nx: int, ny: int) -> Stated:
    """Minimal surface over a square plate."""
    graph, v, at = grid(nx, ny)
    hx, hy = 1.0 / (nx + 1), 1.0 / (ny + 1)
    x, y = np.arange(nx + 2), np.arange(ny + 2)

    def area(a: Any, b: Any, c: Any) -> Any:
        squares = ((b[:, 0] - a[:, 0]) / hx) ** 2 + ((c[:, 0] - a[:, 0]) / hy) ** 2
        return 0.5 * hx * hy * sqrt(1.0 + squares)

    for name, (a, b, c, _) in zip(("lower", "upper"), triangles(v, at), strict=True):
        graph.minimize_scalar(area, a, b, c, name=name)
    guess = np.repeat(1.0 - (2.0 * x * hx - 1.0) ** 2, ny + 2)
    border, inner = edge(at), np.setdiff1d(at, edge(at))
    graph.fix(v[border], guess[border, None])
    plate = (x >= np.floor(0.25 / hx)) & (x <= np.ceil(0.75 / hx))
    over = plate[:, None] & (y >= np.floor(0.25 / hy)) & (y <= np.ceil(0.75 / hy))
    graph.bound(v[inner], lower=over.ravel()[inner, None].astype(float), name="obstacle")
    return graph, {v: guess[:, None]}


def orbit(steps: int) -> Stated:
    """Radius reached by a thrust that turns, in a fixed time; Bryson and Ho, Applied Optimal Control, section 2.5."""

    def rate(x: Any, u: Any) -> Any:
        r, radial, along, t = x[:, 0], x[:, 1], x[:, 2], x[:, 3]
        push = 0.1405 / (1.0 - 0.0749 * t)
        return columns(
            radial,
            along**2 / r - 1.0 / r**2 + push * sin(u[:, 0]),
            -radial * along / r + push * cos(u[:, 0]),
            1.0 + 0.0 * r,
        )

    graph, x, u, t = flight(rate, steps, 4, 1)
    graph.fix(t, 3.32)
    graph.fix(x[0], [1.0, 0.0, 1.0, 0.0])
    graph.constrain(
        lambda end: columns(end[:, 1], end[:, 2] - 1.0 / sqrt(end[:, 0])), x[-1], lower=0.0, upper=0.0, name="circle"
    )
    graph.bound(x, lower=[0.1, -np.inf, -np.inf, -np.inf], name="outside")
    graph.minimize_scalar(lambda end: -end[:, 0], x[-1], name="radius")
    k = np.linspace(0.0, 1.0, steps + 1)
    return graph, {
        x: np.column_stack([1 + 0.5 * k, 0 * k, 1 - 0.2 * k, 3.32 * k]), u: np.full((steps + 1, 1), 0.1), t: [[3.32]],
    }  # fmt: skip


def brachistochrone(steps: int, squared: bool = False) -> Stated:
    """Time, or its square, of a bead on a wire to (10, -5)."""

    def rate(x: Any, u: Any) -> Any:
        return columns(x[:, 2] * sin(u[:, 0]), -x[:, 2] * cos(u[:, 0]), 9.81 * cos(u[:, 0]))

    graph, x, u, t = flight(rate, steps, 3, 1)
    graph.fix(x[0], np.zeros(3))
    graph.constrain(lambda end: end[:, :2], x[-1], lower=[10.0, -5.0], upper=[10.0, -5.0], name="end")
    graph.bound(u, lower=0.0, upper=pi, name="angle")
    graph.bound(t, lower=0.1, name="later")
    graph.minimize_scalar(lambda t: t[:, 0] ** 2 if squared else t[:, 0], t, name="time")
    k = np.linspace(0.0, 1.0, steps + 1)
    return graph, {x: np.column_stack([10 * k, -5 * k, 9.9 * k]), u: np.full((steps + 1, 1), 1.0), t: [[2.0]]}


def landing(steps: int) -> Stated:
    """Fuel of a rocket that lands on Mars in a time of its choice; after Acikmese and Ploen (2007), Table 1."""

    def rate(x: Any, u: Any) -> Any:
        m = x[:, 6:]
        return np.concatenate(
            [x[:, 3:6], u / m - np.array([[0.0, 0.0, 3.7114]]), -5.09e-4 * sqrt((u**2).sum(axis=1))[:, None]], axis=1
        )

    graph, x, u, t = flight(rate, steps, 7, 3)
    graph.fix(x[0], [2000.0, 0.0, 1500.0, 100.0, 0.0, -75.0, 1905.0])
    graph.constrain(lambda end: end[:, :6], x[-1], lower=0.0, upper=0.0, name="landed")
    graph.constrain(lambda u: sqrt((u**2).sum(axis=1))[:, None], u, lower=4972.0, upper=13260.0, name="thrust")
    inf = np.inf
    graph.bound(x, lower=[-inf, -inf, 0.0, -inf, -inf, -inf, 1505.0], name="box")
    graph.bound(t, lower=10.0, upper=200.0, name="later")
    graph.minimize_scalar(lambda end: -end[:, 6], x[-1], name="fuel")
    k = np.linspace(0.0, 1.0, steps + 1)[:, None]
    states = np.array([2000.0, 0.0, 1500.0, 100.0, 0.0, -75.0, 1905.0]) * (1.0 - k)
    states[:, 6:] = 1905.0 - 300.0 * k
    return graph, {x: states, u: np.tile([0.0, 0.0, 8000.0], (steps + 1, 1)), t: [[60.0]]}


LEFT_OUT = {
    "dirichlet, henon, lane-emden": "transition states: a saddle point between given states, not a minimum.",
    "triangle, tetra": "optimal shapes of meshes, which are data files.",
}
PROBLEMS: list[Problem] = [
    Problem("polygon", lambda: polygon(25), -0.77974, mesh="25 corners"),
    Problem("electrons", lambda: electrons(25), 243.813, mesh="25 charges"),
    Problem("chain", lambda: chain(100), 5.06978, mesh="100 steps"),
    Problem("cam", lambda: cam(100), -4.28414, mesh="100 angles"),
    Problem("pinene", lambda: pinene(50), 19.8721, mesh="50 intervals"),
    Problem("marine", lambda: marine(100), 1.97462e7, mesh="100 intervals"),
    Problem("channel", lambda: channel(100), 1.0, mesh="100 intervals"),
    Problem("robot", lambda: robot(100), 9.14267, mesh="100 steps"),
    Problem("steering", lambda: steering(100), 0.554595, mesh="100 steps"),
    Problem("rocket", lambda: rocket(100), -1.01281, mesh="100 steps"),
    Problem("glider", lambda: glider(100), -1255.05, mesh="100 steps"),
    Problem("gas oil", lambda: gas_oil(50), 5.2366e-3, mesh="50 intervals"),
    Problem("methanol", lambda: methanol(50), 9.02229e-3, mesh="50 intervals"),
    Problem("catalyst", lambda: catalyst(50), -4.80579e-2, mesh="50 intervals"),
    Problem("torsion", lambda: torsion(50, 50), -0.418087, mesh="50 x 50"),
    Problem("bearing", lambda: bearing(50, 50), -0.154824, mesh="50 x 50"),
    Problem("surface", lambda: surface(50, 25), 2.51948, mesh="50 x 25"),
    Problem("orbit", lambda: orbit(60), -1.52492, mesh="60 steps"),
    Problem("brachistochrone", lambda: brachistochrone(60), 1.80136, mesh="60 steps"),
    Problem("brachistochrone, squared", lambda: brachistochrone(60, squared=True), 3.24489, mesh="60 steps"),
    Problem("landing", lambda: landing(60), -1514.31, mesh="60 steps"),
]
