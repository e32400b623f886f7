"""Small problems beside the collection: sums of squares without constraints, degenerate ones, and ones without answer.

The sums of squares are from More, Garbow, Hillstrom, Testing Unconstrained Optimization Software, ACM Trans. Math.
Softw. 7 (1981), with their starts and minima.
"""

from __future__ import annotations

import math
from typing import Any

from numpy import arctan2, exp, sqrt

from problems.hock_schittkowski import INF, Case, banana, wood

BARD = [0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39]
KOWALIK_Y = [0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246]
KOWALIK_U = [4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625]


def helix(x: Any, y: Any, z: Any) -> list[Any]:
    """Helical valley of Fletcher and Powell; the angle jumps where x = 0 and y < 0."""
    angle = 0.5 * math.pi + arctan2(-x, y)
    return [10 * (z - 5 / math.pi * angle), 10 * (sqrt(x**2 + y**2) - 1), z]


def bard(a: Any, b: Any, c: Any) -> list[Any]:
    """Fifteen measurements."""
    return [y - (a + k / ((16 - k) * b + min(k, 16 - k) * c)) for k, y in enumerate(BARD, 1)]


def kowalik(a: Any, b: Any, c: Any, d: Any) -> list[Any]:
    """Kowalik and Osborne's enzyme reaction."""
    return [y - a * (u**2 + u * b) / (u**2 + u * c + d) for y, u in zip(KOWALIK_Y, KOWALIK_U, strict=True)]


SQUARES = [
    Case(name="Rosenbrock", start=(-1.2, 1), best=0.0, squares=banana),
    Case(
        name="Freudenstein and Roth", start=(0.5, -2), best=0.0, others=(48.98425368,),
        squares=lambda x, y: [x - 13 + ((5 - y) * y - 2) * y, x - 29 + ((y + 1) * y - 14) * y],
    ),
    Case(
        name="Powell's singular function", start=(3, -1, 0, 1), best=0.0, determined=False,
        squares=lambda a, b, c, d: [a + 10 * b, math.sqrt(5) * (c - d), (b - 2 * c) ** 2, math.sqrt(10) * (a - d) ** 2],
    ),
    Case(name="helical valley", start=(-1, 0, 0), best=0.0, squares=helix),
    Case(
        name="Beale", start=(1, 1), best=0.0,
        squares=lambda x, y: [1.5 - x * (1 - y), 2.25 - x * (1 - y**2), 2.625 - x * (1 - y**3)],
    ),
    Case(name="Bard", start=(1, 1, 1), best=8.214877e-3, squares=bard),
    Case(name="Kowalik and Osborne", start=(0.25, 0.39, 0.415, 0.39), best=3.0750560e-4, squares=kowalik),
    Case(
        name="Jennrich and Sampson", start=(0.3, 0.4), best=124.3621824, judged=1e-3,
        squares=lambda x, y: [2 + 2 * k - (exp(k * x) + exp(k * y)) for k in range(1, 11)],
    ),
    Case(name="Wood", start=(-3, -1, -3, -1), best=0.0, squares=wood),
]  # fmt: skip

DEGENERATE = [
    Case(
        name="an equality stated twice", start=(-4, 1, 1), best=0.0, squares=lambda x, y, z: [x + y, y + z],
        equal=lambda x, y, z: [x + 2 * y + 3 * z - 1, 2 * x + 4 * y + 6 * z - 2],
    ),
    Case(
        name="three lines through a point", start=(0, 0), best=4.0, squares=lambda x, y: [x - 3],
        equal=lambda x, y: [x + y - 2, x - y, 2 * x + y - 3],
    ),
    Case(
        name="limits stated twice", start=(2, 2), best=2.0, squares=lambda x, y: [x + 1, y + 1], lower=0,
        least=lambda x, y: [x, y, x + y, x + 5],
    ),
    Case(
        name="a line touching a circle", start=(3, 0), best=0.0, squares=lambda x, y: [x - 1, y - 1],
        equal=lambda x, y: [x + y - 2, x**2 + y**2 - 2],
    ),
    Case(
        name="one of two is zero", start=(0.6, 0.4), best=1.0, squares=lambda x, y: [x - 1, y - 1], lower=0,
        equal=lambda x, y: [x * y],
    ),
    Case(
        name="one of two is at most zero", start=(0.6, 0.4), best=1.0, squares=lambda x, y: [x - 1, y - 1], lower=0,
        least=lambda x, y: [-x * y],
    ),
    Case(name="active with multiplier zero", start=(3,), best=0.0, squares=lambda x: [x], lower=0),
    Case(name="a free direction", start=(0, 0), best=0.0, squares=lambda x, y: [x + y - 2], lower=-3, upper=3),
    Case(
        name="bounds that meet", start=(3, 3), best=5.0, squares=lambda x, y: [x - 2, y - 4], lower=(1, -INF),
        upper=(1, 2),
    ),
    Case(
        name="rows of very different size", start=(1, 1), best=0.5, squares=lambda x, y: [x, y],
        equal=lambda x, y: [1e4 * (x + y - 1)], least=lambda x, y: [1e-3 * (x - y) + 1e-3],
    ),
    Case(
        name="an equality without slope", start=(1, 1), best=1.0, squares=lambda x, y: [x - 1, y], qualified=False,
        equal=lambda x, y: [x**2],
    ),
    Case(
        name="discs that touch", start=(0.5, 1), best=1.0, squares=lambda x, y: [x, y - 1], qualified=False,
        least=lambda x, y: [1 - (x + 1) ** 2 - y**2, 1 - (x - 1) ** 2 - y**2],
    ),
]  # fmt: skip

INFEASIBLE = [
    Case(
        name="parallel lines", start=(2, 1), best=math.nan, squares=lambda x, y: [x, y],
        equal=lambda x, y: [x + y, x + y - 1],
    ),
    Case(
        name="discs apart", start=(1, 2), best=math.nan, squares=lambda x, y: [x, y - 1],
        least=lambda x, y: [1 - x**2 - y**2, 1 - (x - 4) ** 2 - y**2],
    ),
    Case(
        name="a disc beside bounds", start=(0.5, 0), best=math.nan, squares=lambda x, y: [x, y],
        least=lambda x, y: [1 - x**2 - y**2], lower=(2, -9), upper=(9, 9),
    ),
    Case(name="no real root", start=(2,), best=math.nan, squares=lambda x: [x - 1], equal=lambda x: [x**2 + 1]),
    Case(
        name="a sum beyond its bounds", start=(0.2, 0.9), best=math.nan, squares=lambda x, y: [x, y],
        equal=lambda x, y: [x + y - 3], lower=0, upper=1,
    ),
    Case(
        name="a parabola above a line", start=(3, 3), best=math.nan, squares=lambda x, y: [x - 1, y],
        least=lambda x, y: [y - x**2 - 2, x / 2 - y],
    ),
]  # fmt: skip
