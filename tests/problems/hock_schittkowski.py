"""Problems of Hock and Schittkowski with few unknowns, from their standard starts, with their published optima.

W. Hock, K. Schittkowski, Test Examples for Nonlinear Programming Codes, Springer, 1981. Objectives that are sums of
squares are stated as such; a constant beside the squares is left out, and the optimum is given without it. The cost
of a graph equals the collection's objective: sigma = sqrt(1/2) undoes the 1/2.

The formulas are plain expressions in the unknowns: arrays of NumPy and symbols of CasADi pass through them alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy import cos, exp, log, sin

import unifg as fg
from problems.graphs import graph_with
from unifg.typing import Array

Formula: TypeAlias = Callable[..., Any]
Limits: TypeAlias = Sequence[float] | float

INF = math.inf
ROOT2, ROOT3, ROOT7 = math.sqrt(2.0), math.sqrt(3.0), math.sqrt(7.0)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A small problem in Rn with a known answer.

    Attributes:
        name: for reports.
        start: where every backend begins.
        best: the known minimum; NaN when no point satisfies the constraints.
        others: objective at other KKT points, each verified, where a local method may rightly end.
        squares: residuals r of the objective sum r^2.
        cost: objective that is no sum of squares.
        equal: expressions that are zero.
        least: expressions that are not negative.
        lower, upper: bounds of the unknowns, one for all or one each.
        qualified: whether the constraints have multipliers at the answer; where they have none, the KKT conditions hold
            to a tolerance at points nearby, and the objective is compared to 1e-2 only.
        judged: largest KKT residual that the judge's finite differences can confirm.
        determined: whether the Hessian is regular at the answer.
    """

    name: str
    start: Sequence[float]
    best: float
    others: tuple[float, ...] = ()
    squares: Formula | None = None
    cost: Formula | None = None
    equal: Formula | None = None
    least: Formula | None = None
    lower: Limits = -INF
    upper: Limits = INF
    qualified: bool = True
    judged: float = 2e-6
    determined: bool = True

    @property
    def feasible(self) -> bool:
        """True if an answer exists."""
        return not math.isnan(self.best)

    def build(self) -> tuple[fg.Graph, dict[fg.Family, Array]]:
        """The case as a graph, and its guess."""
        graph, x = graph_with(fg.Rn(len(self.start)))
        if self.squares is not None:
            graph.minimize(_rows(self.squares), x, sigma=math.sqrt(0.5), name="squares")
        if self.cost is not None:
            cost = self.cost
            graph.minimize_scalar(lambda p: cost(*p.T), x, name="cost")
        if self.equal is not None:
            graph.constrain(_rows(self.equal), x, lower=0.0, upper=0.0, name="equalities")
        if self.least is not None:
            graph.constrain(_rows(self.least), x, lower=0.0, name="inequalities")
        if np.isfinite(self.lower).any() or np.isfinite(self.upper).any():
            graph.bound(x, lower=self.lower, upper=self.upper, name="bounds")
        return graph, {x: np.array([self.start], dtype=np.float64)}


def _rows(formula: Formula) -> Callable[[Array], Array]:
    """(n, m) rows of a formula that takes the unknowns one by one."""

    def rows(points: Array) -> Array:
        columns = points.T
        return np.stack([np.zeros(len(points)) + row for row in formula(*columns)], axis=1)

    return rows


def banana(x: Any, y: Any) -> list[Any]:
    """Rosenbrock's residuals."""
    return [10.0 * (y - x**2), 1.0 - x]


def wood(a: Any, b: Any, c: Any, d: Any) -> list[Any]:
    """Colville's fourth function as squares: the last two are (b-1)^2 + (d-1)^2 and their product made square."""
    return [
        10.0 * (b - a**2), 1.0 - a, math.sqrt(90.0) * (d - c**2), 1.0 - c,
        math.sqrt(10.0) * (b + d - 2.0), (b - d) / math.sqrt(10.0),
    ]  # fmt: skip


def hs25(a: Any, b: Any, c: Any) -> list[Any]:
    """Gulf research: 99 residuals."""
    t = [0.01 * k for k in range(1, 100)]
    return [exp(-((25.0 + (-50.0 * math.log(k)) ** (2.0 / 3.0) - b) ** c) / a) - k for k in t]


def product(*x: Any) -> Any:
    """All of them multiplied."""
    result = x[0]
    for value in x[1:]:
        result = result * value
    return result


SMALL = [
    Case(name="HS1", start=(-2, 1), best=0.0, squares=banana, lower=(-INF, -1.5)),
    Case(name="HS2", start=(-2, 1), best=0.0504261879, others=(4.941229318,), squares=banana, lower=(-INF, 1.5)),
    Case(name="HS3", start=(10, 1), best=0.0, cost=lambda x, y: y + 1e-5 * (y - x) ** 2, lower=(-INF, 0)),
    Case(name="HS4", start=(1.125, 0.125), best=8 / 3, cost=lambda x, y: (x + 1) ** 3 / 3 + y, lower=(1, 0)),
    Case(
        name="HS5", start=(0, 0), best=-ROOT3 / 2 - math.pi / 3, lower=(-1.5, -3), upper=(4, 3),
        cost=lambda x, y: sin(x + y) + (x - y) ** 2 - 1.5 * x + 2.5 * y + 1,
    ),
    Case(name="HS6", start=(-1.2, 1), best=0.0, squares=lambda x, y: [1 - x], equal=lambda x, y: [10 * (y - x**2)]),
    Case(
        name="HS7", start=(2, 2), best=-ROOT3,
        cost=lambda x, y: log(1 + x**2) - y, equal=lambda x, y: [(1 + x**2) ** 2 + y**2 - 4],
    ),
    Case(name="HS8", start=(2, 1), best=0.0, equal=lambda x, y: [x**2 + y**2 - 25, x * y - 9]),
    Case(
        name="HS9", start=(0, 0), best=-0.5, equal=lambda x, y: [4 * x - 3 * y],
        cost=lambda x, y: sin(math.pi * x / 12) * cos(math.pi * y / 16),
    ),
    Case(
        name="HS10", start=(-10, 10), best=-1.0,
        cost=lambda x, y: x - y, least=lambda x, y: [-3 * x**2 + 2 * x * y - y**2 + 1],
    ),
    Case(
        name="HS11", start=(4.9, 0.1), best=25 - 8.498464223,
        squares=lambda x, y: [x - 5, y], least=lambda x, y: [y - x**2],
    ),
    Case(
        name="HS12", start=(0, 0), best=-30.0, cost=lambda x, y: x**2 / 2 + y**2 - x * y - 7 * x - 7 * y,
        least=lambda x, y: [25 - 4 * x**2 - y**2],
    ),
    Case(
        name="HS13", start=(-2, -2), best=1.0, squares=lambda x, y: [x - 2, y], qualified=False,
        least=lambda x, y: [(1 - x) ** 3 - y], lower=0,
    ),
    Case(
        name="HS14", start=(2, 2), best=9 - 2.875 * ROOT7, squares=lambda x, y: [x - 2, y - 1],
        equal=lambda x, y: [x - 2 * y + 1], least=lambda x, y: [1 - x**2 / 4 - y**2],
    ),
    Case(
        name="HS15", start=(-2, 1), best=306.5, others=(360.379767,), squares=banana, upper=(0.5, INF),
        least=lambda x, y: [x * y - 1, x + y**2],
    ),
    Case(
        name="HS16", start=(-2, 1), best=0.25, others=(23.144661, 3.982117), squares=banana,
        lower=(-0.5, -INF), upper=(0.5, 1), least=lambda x, y: [x + y**2, x**2 + y],
    ),
    Case(
        name="HS17", start=(-2, 1), best=1.0, squares=banana,
        lower=(-0.5, -INF), upper=(0.5, 1), least=lambda x, y: [y**2 - x, x**2 - y],
    ),
    Case(
        name="HS18", start=(2, 2), best=5.0, squares=lambda x, y: [x / 10, y], lower=(2, 0), upper=50,
        least=lambda x, y: [x * y - 25, x**2 + y**2 - 25],
    ),
    Case(
        name="HS19", start=(20.1, 5.84), best=-6961.81381, cost=lambda x, y: (x - 10) ** 3 + (y - 20) ** 3,
        lower=(13, 0), upper=100,
        least=lambda x, y: [(x - 5) ** 2 + (y - 5) ** 2 - 100, 82.81 - (y - 5) ** 2 - (x - 6) ** 2],
    ),
    Case(
        name="HS20", start=(-2, 1), best=81.5 - 25 * ROOT3, others=(40.198730,), squares=banana,
        lower=(-0.5, -INF), upper=(0.5, INF),
        least=lambda x, y: [x + y**2, x**2 + y, x**2 + y**2 - 1],
    ),
    Case(
        name="HS21", start=(-1, -1), best=0.04, squares=lambda x, y: [x / 10, y],
        least=lambda x, y: [10 * x - y - 10], lower=(2, -50), upper=50,
    ),
    Case(
        name="HS22", start=(2, 2), best=1.0, squares=lambda x, y: [x - 2, y - 1],
        least=lambda x, y: [2 - x - y, y - x**2],
    ),
    Case(
        name="HS23", start=(3, 1), best=2.0, squares=lambda x, y: [x, y], lower=-50, upper=50,
        least=lambda x, y: [x + y - 1, x**2 + y**2 - 1, 9 * x**2 + y**2 - 9, x**2 - y, y**2 - x],
    ),
    Case(
        name="HS24", start=(1, 0.5), best=-1.0, cost=lambda x, y: ((x - 3) ** 2 - 9) * y**3 / (27 * ROOT3), lower=0,
        least=lambda x, y: [x / ROOT3 - y, x + ROOT3 * y, 6 - x - ROOT3 * y],
    ),
    Case(
        name="HS25", start=(100, 12.5, 3), best=0.0, others=(32.835,), squares=hs25, lower=(0.1, 0, 0),
        upper=(100, 25.6, 5),
    ),
    Case(
        name="HS26", start=(-2.6, 2, 2), best=0.0, squares=lambda x, y, z: [x - y, (y - z) ** 2],
        equal=lambda x, y, z: [(1 + y**2) * x + z**4 - 3],
    ),
    Case(
        name="HS27", start=(2, 2, 2), best=0.04, squares=lambda x, y, z: [(x - 1) / 10, y - x**2],
        equal=lambda x, y, z: [x + z**2 + 1],
    ),
    Case(
        name="HS28", start=(-4, 1, 1), best=0.0, squares=lambda x, y, z: [x + y, y + z],
        equal=lambda x, y, z: [x + 2 * y + 3 * z - 1],
    ),
    Case(
        name="HS29", start=(1, 1, 1), best=-16 * ROOT2, cost=lambda x, y, z: -x * y * z,
        least=lambda x, y, z: [48 - x**2 - 2 * y**2 - 4 * z**2],
    ),
    Case(
        name="HS30", start=(1, 1, 1), best=1.0, squares=lambda x, y, z: [x, y, z],
        least=lambda x, y, z: [x**2 + y**2 - 1], lower=(1, -10, -10), upper=10,
    ),
    Case(
        name="HS31", start=(1, 1, 1), best=6.0, squares=lambda x, y, z: [3 * x, y, 3 * z],
        least=lambda x, y, z: [x * y - 1], lower=(-10, 1, -10), upper=(10, 10, 1),
    ),
    Case(
        name="HS32", start=(0.1, 0.7, 0.2), best=1.0, squares=lambda x, y, z: [x + 3 * y + z, 2 * (x - y)], lower=0,
        equal=lambda x, y, z: [1 - x - y - z], least=lambda x, y, z: [6 * y + 4 * z - x**3 - 3],
    ),
    Case(
        name="HS33", start=(0, 0, 3), best=ROOT2 - 6, others=(-4.0,), lower=0, upper=(INF, INF, 5),
        cost=lambda x, y, z: (x - 1) * (x - 2) * (x - 3) + z,
        least=lambda x, y, z: [z**2 - y**2 - x**2, x**2 + y**2 + z**2 - 4],
    ),
    Case(
        name="HS34", start=(0, 1.05, 2.9), best=-math.log(math.log(10)), cost=lambda x, y, z: -x,
        least=lambda x, y, z: [y - exp(x), z - exp(y)], lower=0, upper=(100, 100, 10),
    ),
    Case(
        name="HS35", start=(0.5, 0.5, 0.5), best=1 / 9, lower=0, least=lambda x, y, z: [3 - x - y - 2 * z],
        cost=lambda x, y, z: (
            9 - 8 * x - 6 * y - 4 * z + 2 * x**2 + 2 * y**2 + z**2 + 2 * x * y + 2 * x * z
        ),
    ),
    Case(
        name="HS36", start=(10, 10, 10), best=-3300.0, cost=lambda x, y, z: -x * y * z,
        least=lambda x, y, z: [72 - x - 2 * y - 2 * z], lower=0, upper=(20, 11, 42),
    ),
    Case(
        name="HS37", start=(10, 10, 10), best=-3456.0, cost=lambda x, y, z: -x * y * z,
        least=lambda x, y, z: [72 - x - 2 * y - 2 * z, x + 2 * y + 2 * z], lower=0, upper=42,
    ),
    Case(name="HS38", start=(-3, -1, -3, -1), best=0.0, squares=wood, lower=-10, upper=10),
    Case(
        name="HS39", start=(2, 2, 2, 2), best=-1.0, cost=lambda a, b, c, d: -a,
        equal=lambda a, b, c, d: [b - a**3 - c**2, a**2 - b - d**2],
    ),
    Case(
        name="HS40", start=(0.8, 0.8, 0.8, 0.8), best=-0.25, cost=lambda a, b, c, d: -a * b * c * d,
        equal=lambda a, b, c, d: [a**3 + b**2 - 1, a**2 * d - c, d**2 - b],
    ),
    Case(
        name="HS41", start=(2, 2, 2, 2), best=52 / 27, cost=lambda a, b, c, d: 2 - a * b * c,
        equal=lambda a, b, c, d: [a + 2 * b + 2 * c - d], lower=0, upper=(1, 1, 1, 2),
    ),
    Case(
        name="HS42", start=(1, 1, 1, 1), best=28 - 10 * ROOT2,
        squares=lambda a, b, c, d: [a - 1, b - 2, c - 3, d - 4], equal=lambda a, b, c, d: [a - 2, c**2 + d**2 - 2],
    ),
    Case(
        name="HS43", start=(0, 0, 0, 0), best=-44.0,
        cost=lambda a, b, c, d: a**2 + b**2 + 2 * c**2 + d**2 - 5 * a - 5 * b - 21 * c + 7 * d,
        least=lambda a, b, c, d: [
            8 - a**2 - b**2 - c**2 - d**2 - a + b - c + d,
            10 - a**2 - 2 * b**2 - c**2 - 2 * d**2 + a + d,
            5 - 2 * a**2 - b**2 - c**2 - 2 * a + b + d,
        ],
    ),
    Case(
        name="HS44", start=(0, 0, 0, 0), best=-15.0, others=(-13.0,), lower=0,
        cost=lambda a, b, c, d: a - b - c - a * c + a * d + b * c - b * d,
        least=lambda a, b, c, d: [
            8 - a - 2 * b, 12 - 4 * a - b, 12 - 3 * a - 4 * b, 8 - 2 * c - d, 8 - c - 2 * d, 5 - c - d,
        ],
    ),
    Case(
        name="HS45", start=(2, 2, 2, 2, 2), best=1.0, cost=lambda *x: 2 - product(*x) / 120, lower=0,
        upper=(1, 2, 3, 4, 5),
    ),
    Case(
        name="HS46", start=(ROOT2 / 2, 1.75, 0.5, 2, 2), best=0.0,
        squares=lambda a, b, c, d, e: [a - b, c - 1, (d - 1) ** 2, (e - 1) ** 3],
        equal=lambda a, b, c, d, e: [a**2 * d + sin(d - e) - 1, b + c**4 * d**2 - 2],
    ),
    Case(
        name="HS47", start=(2, ROOT2, -1, 2 - ROOT2, 0.5), best=-0.0267141826, others=(0.0,),
        cost=lambda a, b, c, d, e: (a - b) ** 2 + (b - c) ** 3 + (c - d) ** 4 + (d - e) ** 4,
        equal=lambda a, b, c, d, e: [a + b**2 + c**3 - 3, b - c**2 + d - 1, a * e - 1],
    ),
    Case(
        name="HS48", start=(3, 5, -3, 2, -2), best=0.0, squares=lambda a, b, c, d, e: [a - 1, b - c, d - e],
        equal=lambda a, b, c, d, e: [a + b + c + d + e - 5, c - 2 * (d + e) + 3],
    ),
    Case(
        name="HS49", start=(10, 7, 2, -3, 0.8), best=0.0,
        squares=lambda a, b, c, d, e: [a - b, c - 1, (d - 1) ** 2, (e - 1) ** 3],
        equal=lambda a, b, c, d, e: [a + b + c + 4 * d - 7, c + 5 * e - 6],
    ),
    Case(
        name="HS50", start=(35, -31, 11, 5, -5), best=0.0,
        squares=lambda a, b, c, d, e: [a - b, b - c, (c - d) ** 2, d - e],
        equal=lambda a, b, c, d, e: [a + 2 * b + 3 * c - 6, b + 2 * c + 3 * d - 6, c + 2 * d + 3 * e - 6],
    ),
    Case(
        name="HS51", start=(2.5, 0.5, 2, -1, 0.5), best=0.0,
        squares=lambda a, b, c, d, e: [a - b, b + c - 2, d - 1, e - 1],
        equal=lambda a, b, c, d, e: [a + 3 * b - 4, c + d - 2 * e, b - e],
    ),
    Case(
        name="HS52", start=(2, 2, 2, 2, 2), best=1859 / 349,
        squares=lambda a, b, c, d, e: [4 * a - b, b + c - 2, d - 1, e - 1],
        equal=lambda a, b, c, d, e: [a + 3 * b, c + d - 2 * e, b - e],
    ),
    Case(
        name="HS53", start=(2, 2, 2, 2, 2), best=176 / 43, lower=-10, upper=10,
        squares=lambda a, b, c, d, e: [a - b, b + c - 2, d - 1, e - 1],
        equal=lambda a, b, c, d, e: [a + 3 * b, c + d - 2 * e, b - e],
    ),
]  # fmt: skip
